"""Random contacts with curved surfaces and edges, on which networks are trained."""

import math

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.edge_samples import EdgeRanges, edge_contacts, frame_on_rim
from touchcell.simulation.edge_ways import contacts_on_way
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.smoothing import TriangleMesh
from touchcell.simulation.pressed import felt_when_pressed
from touchcell.simulation.random_parts import random_part, steep_part
from touchcell.simulation.samples import SampledContact, Variation
from touchcell.simulation.shape_samples import shape_contacts
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import Tip, mirrored

STILL = Variation(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def contacts_mm_deg(samples: list[SampledContact]) -> np.ndarray:
    return np.array([se3.to_euler_mm_deg(each.T_f_s) for each in samples])


def test_edge_contacts_are_the_same_for_the_same_seed_and_within_their_ranges() -> None:
    ranges = EdgeRanges()
    one, two = list(edge_contacts(96, 5)), list(edge_contacts(96, 5))
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.T_f_s, b.T_f_s)
        assert np.array_equal(a.pixels, b.pixels)
    found = contacts_mm_deg(one)
    assert np.abs(found[:, 0]).max() <= ranges.offset_mm
    assert np.abs(found[:, 1]).max() <= 0.1 + 1e-9
    assert found[:, 2].min() >= ranges.depth_mm[0]
    assert found[:, 2].max() <= ranges.depth_mm[1]
    assert found[:, 5].std() > 10.0


def test_surface_contacts_reach_through_depth_tilt_and_shear() -> None:
    found = contacts_mm_deg(list(shape_contacts(320, 2, depth_mm=(0.0, 6.5))))
    assert found[:, 2].min() < 0.5
    assert 6.0 < found[:, 2].max() <= 6.5
    assert 20.0 < np.hypot(found[:, 3], found[:, 4]).max() < 40.0
    assert np.hypot(found[:, 0], found[:, 1]).max() > 3.0


def test_curvature_changes_what_the_camera_sees_of_the_same_contact() -> None:
    samples = list(shape_contacts(640, 4, depth_mm=(2.9, 3.1), variation=STILL))
    # Batches on planes and on bent surfaces see different marker fields at the same depth.
    spread = np.std([np.linalg.norm(each.markers - samples[0].markers, axis=1).mean() for each in samples])
    assert spread > 1.0


@pytest.mark.parametrize("seed", range(12))
def test_random_parts_have_an_edge_with_their_face_above_and_a_wall_below(seed: int) -> None:
    part = random_part(np.random.default_rng(seed))
    shape = MeshShape(part, math.radians(30.0))
    edges = shape.edges
    normals = edges.middle_normals
    upper = normals[:, :, 2].max(axis=1) > 0.64
    assert upper.any()
    i = int(np.flatnonzero(upper)[0])
    face = normals[i, normals[i, :, 2].argmax()]
    middle = 0.5 * (edges.starts[i] + edges.ends[i])
    assert shape.nearest(middle + 0.017 * face).distance_m == pytest.approx(0.017, abs=2e-4)


def test_steep_parts_spread_over_the_angles_of_rims_and_tell_the_normals_of_their_faces() -> None:
    angles_deg = []
    for seed in range(12):
        part = steep_part(np.random.default_rng(seed))
        assert part.normals is not None
        shape = MeshShape(part, math.radians(30.0))
        normals = shape.edges.middle_normals
        rim = normals[:, :, 2].max(axis=1) > 0.64
        cos = np.einsum("kc,kc->k", normals[rim, 0], normals[rim, 1])
        angles_deg.append(180.0 - math.degrees(math.acos(np.clip(np.median(cos), -1.0, 1.0))))
    assert min(angles_deg) < 75.0
    assert max(angles_deg) > 115.0


def test_no_contact_is_drawn_at_the_border_of_a_part_that_is_open_below() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shape = MeshShape(random_part(rng), math.radians(30.0))
        surface = Surface(shape)
        for _ in range(5):
            T_world_e = frame_on_rim(shape, surface, 0.020, rng)
            at = shape.edges.nearest(T_world_e[:3, 3] + 0.020 * T_world_e[:3, 2])
            assert float(at.normals[0] @ at.normals[1]) < math.cos(math.radians(25.0))


def test_a_longer_draw_begins_with_the_shorter_one() -> None:
    one, two = list(edge_contacts(40, 3, part=steep_part)), list(edge_contacts(72, 3, part=steep_part))
    assert all(np.array_equal(a.pixels, b.pixels) for a, b in zip(one, two[:40], strict=True))


def test_every_other_contact_is_the_one_before_it_in_a_mirror() -> None:
    found = contacts_mm_deg(list(edge_contacts(8, 3, variation=STILL)))
    np.testing.assert_allclose(found[1::2, [0, 2, 4]], found[::2, [0, 2, 4]], atol=1e-9)
    np.testing.assert_allclose(found[1::2, [3, 5]], -found[::2, [3, 5]], atol=1e-9)
    assert np.abs(found[:, 5]).max() > 1.0


def test_a_mirrored_part_gives_the_mirrored_contact() -> None:
    rng, law, tip = np.random.default_rng(3), ContactLaw(), Tip()
    mesh = steep_part(rng)
    assert mesh.normals is not None
    over = np.array([1.0, -1.0, 1.0])
    # The corners of a face go the other way round, so that it still faces outwards.
    faces, normals = np.ascontiguousarray(mesh.faces[:, ::-1]), np.ascontiguousarray((mesh.normals * over)[:, ::-1])
    shape = MeshShape(mesh, math.radians(30.0))
    one, other = (
        Surface(shape),
        Surface(MeshShape(TriangleMesh(mesh.vertices * over, faces, normals), math.radians(30.0))),
    )
    T_world_e = frame_on_rim(shape, one, law.tip_radius_m, rng)
    T_start = se3.compose(T_world_e, se3.from_euler_mm_deg([-0.5, 2.0, 3.0, 4.0, -5.0, 8.0]))
    T_world_s = se3.compose(T_world_e, se3.from_euler_mm_deg([0.5, 0.0, 3.0, 4.0, -5.0, 12.0]))
    _, felt = felt_when_pressed(one, tip, law, T_start, T_world_s)
    _, expected = felt_when_pressed(other, tip, law, mirrored(T_start), mirrored(T_world_s))
    found = felt.mirrored()
    np.testing.assert_allclose(found.T_f_s, expected.T_f_s, atol=1e-12)
    assert found.relief is not None
    assert expected.relief is not None
    assert np.abs(found.relief).max() > 1e-4
    np.testing.assert_allclose(found.relief, expected.relief, atol=1e-12)


def test_contacts_on_ways_are_held_as_a_controller_holds_them_and_turn_far_at_corners() -> None:
    rng, law, tip, labels = np.random.default_rng(2), ContactLaw(), Tip(), []
    for seed in range(6):
        shape = MeshShape(random_part(np.random.default_rng(seed)), math.radians(30.0))
        surface = Surface(shape)
        T_world_e = frame_on_rim(shape, surface, law.tip_radius_m, rng, at_corners=1.0, beside_corner_m=15e-3)
        labels += [label for label, _ in contacts_on_way(surface, tip, law, T_world_e, rng, 60)]
    found = np.abs(np.array(labels) - [0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    assert len(found) > 50
    np.testing.assert_array_less(np.median(found, axis=0), [1.0, 2.0, 1.0, 4.0, 4.0, 8.0])
    assert found[:, 5].max() > 45.0
