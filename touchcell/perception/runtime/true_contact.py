"""The true contact in place of an estimate, to separate control error from estimation error."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from touchcell.errors import ConfigError
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec

if TYPE_CHECKING:
    from touchcell.perception.runtime.pipeline import ContactSource


class TrueContact(EstimatorConfig):
    """The simulator's own contact state, or the label of a replayed image."""

    needs_truth: ClassVar[bool] = True

    kind: Literal["true_contact"]

    def build(self, context: EstimatorContext) -> ContactSource:
        """Return the source of the true contact. Raises ConfigError where it is not known."""
        if context.truth is None:
            key = f"sensors.{context.sensor}.estimator.kind"
            raise ConfigError("the true contact is not known here", key=key, value=self.kind, hint="use kind: network")
        return context.truth


TRUE_CONTACT = EstimatorSpec("true_contact", "the simulator's own contact, or a replayed image's label", TrueContact)
