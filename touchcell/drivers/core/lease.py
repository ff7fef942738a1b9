"""Who may command a device: one owner at a time."""

from __future__ import annotations

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

    @property
    def owner(self) -> str | None:
        """Name of the present owner."""
        return self._held.owner if self._held else None

    def acquire(self, owner: str) -> Lease:
        """Give ``owner`` the lease. Raises CommandRejected(LEASE) while anyone holds it."""
        if self._held is not None:
            raise CommandRejected(
                self._device,
                Rejection.LEASE,
                f"the command lease is held by {self._held.owner!r}",
                value=owner,
                hint="release it first; a device obeys one owner at a time",
            )
        self._epoch += 1
        self._held = Lease(self._device, owner, self._epoch)
        return self._held

    def release(self, lease: Lease) -> None:
        """Take the lease back; releasing one that is no longer held changes nothing."""
        if self._held is lease:
            self._held = None

    def revoke(self) -> None:
        """Void whatever lease is out."""
        self._held = None

    def check(self, lease: Lease) -> None:
        """Raise CommandRejected(LEASE) unless ``lease`` is the one that is held."""
        if lease is not self._held:
            raise CommandRejected(
                self._device,
                Rejection.LEASE,
                f"{lease.owner!r} does not hold the command lease",
                value=lease.owner,
            )
