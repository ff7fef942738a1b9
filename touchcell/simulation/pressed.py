"""A simulated tip dragged into a contact with any surface: the contact that remains, and what its camera sees."""

from __future__ import annotations

from touchcell.drivers.core.scene import ContactState
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import SkinContact, Tip


def pressed(
    surface: Surface, tip: Tip, law: ContactLaw, T_start: Array, T_world_s: Array
) -> tuple[ContactState, Array]:
    """Return the contact after a straight way from ``T_start`` to ``T_world_s`` (4, 4), and pixels (markers, 2)."""
    state, felt = felt_when_pressed(surface, tip, law, T_start, T_world_s)
    return state, tip.pixels(felt.T_f_s, felt.relief)


def felt_when_pressed(
    surface: Surface, tip: Tip, law: ContactLaw, T_start: Array, T_world_s: Array
) -> tuple[ContactState, SkinContact]:
    """Return the contact after a straight way from ``T_start`` to ``T_world_s`` (4, 4), and what the skin feels."""
    model = ContactModel(law)
    model.step(T_start, surface, 0.0)
    state = model.step(T_world_s, surface, 0.0)
    relief = felt_relief(surface, T_world_s, 0.0, tip.relief.directions, law.tip_radius_m)
    return state, SkinContact(state.T_f_s, relief)
