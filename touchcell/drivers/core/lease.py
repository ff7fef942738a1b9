"""Who may command a device: one owner at a time."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from touchcell.drivers.core.errors import CommandRejected, Rejection


@dataclass(frozen=True, slots=True)
class Lease:
    """Proof of ownership; compared by identity, so a copy or an old one is worth nothing."""

    device: str
    owner: str
    epoch: int


class LeaseManager:
    """Hands out the lease of one device, to one owner at a time."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._held: Lease | None = None
        self._epoch = 0
        # Two threads that ask at once must not both be given it.
        self._lock = threading.Lock()

    @property
    def owner(self) -> str | None:
        """Name of the present owner."""
        held = self._held
        return held.owner if held else None

    def acquire(self, owner: str) -> Lease:
        """Give ``owner`` the lease. Raises CommandRejected(LEASE) while anyone holds it."""
        with self._lock:
            if (held := self._held) is not None:
                raise CommandRejected(
                    self._device,
                    Rejection.LEASE,
                    f"the command lease is held by {held.owner!r}",
                    value=owner,
                    hint="release it first; a device obeys one owner at a time",
                )
            self._epoch += 1
            self._held = lease = Lease(self._device, owner, self._epoch)
        return lease

    def release(self, lease: Lease) -> None:
        """Take the lease back; releasing one that is no longer held changes nothing."""
        with self._lock:
            if self._held is lease:
                self._held = None

    def revoke(self) -> None:
        """Void whatever lease is out."""
        self._held = None

    def check(self, lease: Lease | None) -> None:
        """Raise CommandRejected(LEASE) unless ``lease`` is the very one that is held. While none is, none passes."""
        held = self._held
        if held is None or lease is not held:
            owner = getattr(lease, "owner", None)
            raise CommandRejected(
                self._device,
                Rejection.LEASE,
                f"{owner!r} does not hold the command lease",
                value=owner,
                hint="acquire() gives it, once an earlier owner has released it",
            )
