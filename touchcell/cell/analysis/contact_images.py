"""Images of a sensor's contacts with marker displacements, from the images of a recording alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from touchcell.cell.recording.mcap import Message, read
from touchcell.cell.recording.recorded_images import ImageDecoder
from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import ImageError
from touchcell.perception.markers.figures import draw_contact, write_markers
from touchcell.perception.markers.tracking import MarkerTracker, TrackedMarkers
from touchcell.perception.models.preprocessing import Preprocessing

if TYPE_CHECKING:
    from touchcell.cell.analysis.run_data import Run

_PICTURES = 5


@dataclass(frozen=True, slots=True)
class ContactPicture:
    """One recorded image.

    Attributes:
        role: of the sensor.
        t_ns: time of exposure.
        image: uint8 (height, width), black and white, the image in which markers were detected.
        markers: its markers, tracked since the recording's first image.
        spacing_px: of neighbouring markers in the first image.
    """

    role: str
    t_ns: int
    image: ImageArray
    markers: TrackedMarkers
    spacing_px: float

    def drawn(self) -> ImageArray:
        """Return uint8 (height, 2 width, 3) BGR: displacement arrows and change of density."""
        markers = self.markers
        return draw_contact(self.image, markers.reference, markers.positions, self.spacing_px, arrows=markers.followed)


def contact_pictures(messages: Iterable[Message]) -> Iterator[ContactPicture]:
    """Yield each recorded image with its markers; images without detectable markers are skipped.

    The first image of a sensor counts as undeformed, as a run begins out of contact.
    """
    chains: dict[str, Preprocessing] = {}
    trackers: dict[str, MarkerTracker] = {}
    decoder = ImageDecoder()
    for message in messages:
        parts = message.topic.split("/")
        if len(parts) != 4 or parts[1] != "sensors":
            continue
        role, leaf = parts[2:]
        if leaf == "preprocessing":
            try:
                chains[role] = Preprocessing.model_validate(message.data).in_full_resolution()
            except ValidationError:
                continue
        if role not in chains:
            continue
        try:
            recorded = decoder.decode(message)
            if recorded is None:
                continue
            image = chains[role].reduce(recorded.image)
            if role not in trackers:
                trackers[role] = MarkerTracker(image)
            markers = trackers[role].update(image)
        except ImageError:
            continue
        yield ContactPicture(role, message.t_ns, image, markers, trackers[role].spacing_px)


def write_strip(recording: Path, run: Run, role: str, path: Path) -> Path | None:
    """Write a figure of a few contacts of a run, arrows above and density below; None where there are none.

    Args:
        recording: of the run.
        run: its series.
        role: of the sensor.
        path: PNG to write.

    Raises:
        RecordingError: the recording is missing.
    """
    contact = run.series(f"/sensors/{role}/contact")
    if contact is None:
        return None
    touching_s = contact.t_s[np.array([bool(row.get("in_contact")) for row in contact.rows], dtype=bool)]
    if not len(touching_s):
        return None
    wanted_s = np.linspace(touching_s[0], touching_s[-1], _PICTURES + 2)[1:-1].tolist()
    shown: list[tuple[float, ContactPicture]] = []
    for picture in contact_pictures(read(recording)):
        t_s = (picture.t_ns - run.start_ns) * 1e-9
        if picture.role == role and wanted_s and t_s >= wanted_s[0]:
            del wanted_s[0]
            if picture.markers.followed:
                shown.append((t_s, picture))
    if not shown:
        return None
    first = shown[0][1]
    write_markers(
        path,
        first.markers.reference,
        [picture.markers.positions for _, picture in shown],
        [f"t = {t_s:.2f} s" for t_s, _ in shown],
        (first.image.shape[0], first.image.shape[1]),
        first.spacing_px,
    )
    return path
