"""An arm: the simulated one, with a payload that its driver checks."""

from pydantic import Field

from touchcell.drivers.core.protocols import SERVO_ARM, HealthSource
from touchcell.drivers.core.spec import Capabilities, DriverContext, DriverSpec
from touchcell.simulation.devices.arm import SimArm, SimArmConfig
from touchcell.simulation.scene import Scene


class AcmeArmConfig(SimArmConfig):
    """Keys of an arm with this driver."""

    payload_kg: float = Field(gt=0.0, le=5.0)


def build(name: str, config: AcmeArmConfig, context: DriverContext) -> SimArm:
    scene = context.scene
    return SimArm(name, config, context.clock, scene.timeline if isinstance(scene, Scene) else None)


SPEC = DriverSpec(
    name="acme_arm",
    summary="arm of another package",
    config=AcmeArmConfig,
    capabilities=Capabilities(
        kind="arm",
        provides=SERVO_ARM | {HealthSource},
        state_rate_hz=500.0,
        stop_categories=frozenset({1, 2}),
        virtual_time=True,
    ),
    build=build,
)
