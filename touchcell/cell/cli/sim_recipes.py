"""What ``touchcell train-sim`` trains and on what, and how models that ship were made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

if TYPE_CHECKING:
    from touchcell.perception.runtime.estimator_spec import Feature

Feels: TypeAlias = Literal["plane", "shape"]
"""What surfaces are made of."""

Tips: TypeAlias = Literal["one", "spread"]
"""How far the sensors are apart."""

DEEPEST_MM: Final = 6.5
"""Beyond the depth at which objects are tracked, so that it is not outside the training range."""


@dataclass(frozen=True, slots=True)
class SimRecipe:
    """A training on simulated contacts; without arguments that of ``train-sim`` without options.

    Attributes:
        samples: training images.
        kind: gdn, cnn or markers. Marker fields are not drawn: the centroids of drawn discs are off by 0.07 px.
        tip: a tip file, or the name of one that ships; None for the default tip.
        processed: for images as the public data have them rather than raw frames.
        epochs: passes over the samples; None for the kind's default.
        seed: of everything random.
        feature: ``edge`` for contacts with edges, of the default tip; ``kinds`` for a classifier of what is touched.
        feels: ``shape`` for surfaces that bend, of the default tip.
        tips: ``one`` for sensors that scatter a little about one; ``spread`` for such as differ (``tip_spread``), on
            surfaces.
        deepest_mm: largest depth.
    """

    samples: int = 12_000
    kind: str = "gdn"
    tip: str | None = None
    processed: bool = False
    epochs: int | None = None
    seed: int = 0
    feature: Feature | Literal["kinds"] = "surface"
    feels: Feels = "plane"
    tips: Tips = "one"
    deepest_mm: float = DEEPEST_MM


PRESETS: Final = {
    "sim_edge": SimRecipe(samples=172_000, kind="markers", epochs=16, feature="edge"),
    "sim_kinds": SimRecipe(samples=20_000, epochs=20, feature="kinds"),
    "sim_shape": SimRecipe(samples=40_000, kind="markers", epochs=20, feels="shape"),
    # Objects that need force press in by 7 mm before an interlock stops the arm.
    "sim_tips": SimRecipe(samples=60_000, kind="markers", epochs=16, feels="shape", tips="spread", deepest_mm=8.0),
}
"""How the models of these names were made."""
