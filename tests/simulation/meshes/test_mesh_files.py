"""Mesh files of cell files: read, refused with file, line, key and remedy, repaired on request."""

from pathlib import Path

import numpy as np
import pytest

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.errors import ConfigError
from touchcell.simulation.meshes import primitives
from touchcell.simulation.meshes.load import load_mesh, what_is_open
from touchcell.simulation.meshes.mesh_shape import MeshShape
from touchcell.simulation.meshes.pieces import volume_m3
from touchcell.simulation.meshes.smoothing import TriangleMesh

trimesh = pytest.importorskip("trimesh")

MM = 1e-3
CELL = """extends: surface_follow_sim.yaml
name: part
scene:
  surfaces:
    ramp:
      kind: mesh
      file: {file}
      unit: {unit}
      pose_mm_deg: [0, 0, -20, 0, 0, 0]
arms:
  arm: {{start_pose_mm_deg: [0, 0, 45, 180, 0, 0]}}
interlocks: {{workspace: {{min_mm: [-100, -50, -30]}}}}
task: {{distance_mm: 5}}
"""


def export(path: Path, mesh: TriangleMesh, scale: float = 1e3) -> Path:
    trimesh.Trimesh(scale * mesh.vertices, mesh.faces, process=False).export(path)
    return path


def without(mesh: TriangleMesh, count: int) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:-count])


BALL = primitives.ball(0.04, rows=17, sections=32)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_stl_obj_and_ply_are_the_same_mesh(tmp_path: Path, suffix: str) -> None:
    mesh = load_mesh(export(tmp_path / f"ball.{suffix}", BALL), "mm", repair=False)
    assert len(mesh.faces) == len(BALL.faces)
    assert len(mesh.vertices) == len(BALL.vertices)
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(0.08, abs=1e-6)


def test_a_cell_finds_its_mesh_beside_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "there").mkdir()
    export(tmp_path / "there" / "ball.stl", BALL)
    (tmp_path / "there" / "cell.yaml").write_text(CELL.format(file="ball.stl", unit="mm"))
    monkeypatch.chdir(tmp_path)
    plan = plan_cell(Path("there/cell.yaml"))
    assert plan.cell.scene is not None
    assert Path(plan.cell.scene["surfaces"]["ramp"]["file"]) == tmp_path / "there" / "ball.stl"
    assert str(tmp_path / "there" / "ball.stl") in plan.text()


@pytest.mark.parametrize(
    ("file", "unit", "key", "line", "part"),
    [
        ("missing.stl", "mm", "file", 7, "no such file"),
        ("ball.stl", "m", "unit", 8, "unit: mm"),
        ("inches.stl", "mm", "unit", 8, "unit: inch"),
        ("hole.stl", "mm", "file", 7, "repair: true"),
        ("flipped.stl", "mm", "file", 7, "repair: true"),
        ("inside_out.stl", "mm", "file", 7, "repair: true"),
        ("text.stl", "mm", "file", 7, "export"),
        ("cut.stl", "mm", "file", 7, "STL"),
        ("empty.obj", "mm", "file", 7, "empty"),
        ("points.obj", "mm", "file", 7, "no faces"),
        ("infinite.obj", "mm", "file", 7, "finite"),
        ("ball.step", "mm", "file", 7, "STL"),
    ],
)
def test_a_bad_mesh_is_named_with_line_key_and_remedy(
    tmp_path: Path, file: str, unit: str, key: str, line: int, part: str
) -> None:
    whole = export(tmp_path / "ball.stl", BALL).read_bytes()
    export(tmp_path / "inches.stl", BALL, 1.0 / 25.4e-3)
    export(tmp_path / "hole.stl", without(BALL, 4))
    export(tmp_path / "inside_out.stl", TriangleMesh(BALL.vertices, BALL.faces[:, ::-1]))
    flipped = BALL.faces.copy()
    flipped[::7] = flipped[::7, ::-1]
    export(tmp_path / "flipped.stl", TriangleMesh(BALL.vertices, flipped))
    (tmp_path / "text.stl").write_text("this is no mesh\n")
    (tmp_path / "cut.stl").write_bytes(whole[:1000])
    (tmp_path / "empty.obj").write_text("")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 50 0 0\n")
    (tmp_path / "infinite.obj").write_text("v 0 0 0\nv 50 0 nan\nv 0 50 0\nf 1 2 3\n")
    (tmp_path / "ball.step").write_bytes(whole)
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL.format(file=file, unit=unit))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(cell)
    (problem,) = caught.value.problems
    assert (problem.key, problem.line, problem.file) == (f"scene.surfaces.ramp.{key}", line, str(cell))
    assert part in str(problem)


def test_the_unit_is_never_guessed(tmp_path: Path) -> None:
    export(tmp_path / "ball.stl", BALL)
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL.format(file="ball.stl", unit="mm").replace("      unit: mm\n", ""))
    with pytest.raises(ConfigError) as caught:
        plan_cell(cell)
    assert "unit" in str(caught.value)


def test_a_repair_closes_small_holes_and_orients_faces(tmp_path: Path) -> None:
    damaged = without(BALL, 4).faces.copy()
    damaged[::7] = damaged[::7, ::-1]
    path = export(tmp_path / "damaged.stl", TriangleMesh(BALL.vertices, damaged))
    mended = load_mesh(path, "mm", repair=True)
    assert not what_is_open(mended)
    a, b, c = (mended.vertices[mended.faces[:, i]] for i in range(3))
    assert np.einsum("mc,mc->", a, np.cross(b, c)) > 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_repaired_sheet_is_a_thin_wall_that_can_be_touched_from_both_sides(tmp_path: Path, side: float) -> None:
    x = np.linspace(-0.05, 0.05, 21)
    sheet = primitives.height_field(np.add.outer(-5.0 * x**2, 5.0 * x**2), float(x[1] - x[0]))
    top = sheet.faces[sheet.face_normals()[:, 2] > 0.0]
    mended = load_mesh(export(tmp_path / "saddle.stl", TriangleMesh(sheet.vertices, top)), "mm", repair=True)
    assert not what_is_open(mended)
    found = MeshShape(mended, 0.5).nearest(np.array([0.0, 0.0, side * 17e-3]))
    assert found.distance_m == pytest.approx(17e-3, abs=0.11e-3)
    assert found.normal == pytest.approx([0.0, 0.0, side], abs=1e-3)
    assert volume_m3(mended) == pytest.approx(0.1 * 0.1 * 0.2e-3, rel=0.1)


def test_a_solid_whose_corners_nearly_coincide_is_welded_by_a_repair(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    corners = BALL.vertices[BALL.faces].reshape(-1, 3)
    corners = corners + rng.uniform(-2e-6, 2e-6, corners.shape)
    soup = TriangleMesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
    path = export(tmp_path / "soup.stl", soup)
    with pytest.raises(ConfigError, match="edges of one face only"):
        load_mesh(path, "mm", repair=False)
    mended = load_mesh(path, "mm", repair=True)
    assert len(mended.faces) == len(BALL.faces)
    assert volume_m3(mended) == pytest.approx(volume_m3(BALL), rel=1e-3)


def test_a_mesh_of_size_one_is_told_about_scale(tmp_path: Path) -> None:
    path = export(tmp_path / "ball.obj", BALL, scale=12.5)
    with pytest.raises(ConfigError) as refused:
        load_mesh(path, "mm", repair=False)
    assert "`scale`" in refused.value.hint


def test_a_mesh_that_was_normalised_is_scaled(tmp_path: Path) -> None:
    path = export(tmp_path / "ball.obj", BALL, scale=12.5)
    mesh = load_mesh(path, "m", scale=0.08, repair=False)
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(0.08, abs=1e-6)
    with pytest.raises(ConfigError) as refused:
        load_mesh(path, "mm", scale=0.08, repair=False)
    assert refused.value.key == "unit"


def test_a_nearly_closed_vessel_that_is_inside_out_is_turned_round_and_a_hollow_piece_beside_it_kept(
    tmp_path: Path,
) -> None:
    vessel = TriangleMesh(BALL.vertices, BALL.faces[:-20, ::-1])
    other = TriangleMesh(BALL.vertices + np.array([0.1, 0.0, 0.0]), BALL.faces)
    both = TriangleMesh(
        np.concatenate([vessel.vertices, other.vertices]),
        np.concatenate([vessel.faces, other.faces + len(vessel.vertices)]),
    )
    mended = load_mesh(export(tmp_path / "vessels.stl", both), "mm", repair=True)
    middles = mended.vertices[mended.faces].mean(axis=1)
    centres = np.where(middles[:, :1] > 0.05, [[0.1, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    assert np.all(np.einsum("mc,mc->m", mended.face_normals(), middles - centres) > 0.0)


def test_check_names_hollows_into_which_the_tip_does_not_fit(tmp_path: Path) -> None:
    valley = np.abs(np.linspace(-0.05, 0.05, 41)) * 0.5
    creased = primitives.height_field(np.repeat(valley[None], 41, axis=0), 2.5e-3)
    narrow = primitives.height_field(np.repeat((np.linspace(-0.01, 0.01, 41) ** 2 / 0.02)[None], 41, axis=0), 0.5e-3)
    wide = primitives.height_field(np.repeat((np.linspace(-0.05, 0.05, 41) ** 2 / 0.1)[None], 41, axis=0), 2.5e-3)
    notes = {}
    for name, mesh in (("creased", creased), ("narrow", narrow), ("wide", wide)):
        export(tmp_path / f"{name}.stl", mesh)
        cell = tmp_path / f"{name}.yaml"
        cell.write_text(CELL.format(file=f"{name}.stl", unit="mm\n      repair: true"))
        notes[name] = " ".join(plan_cell(cell).notes)
    assert "scene.surfaces.ramp" in notes["creased"]
    assert "of its creases are hollow" in notes["creased"]
    assert "down to a radius of" in notes["narrow"]
    assert not notes["wide"]


def as_drawing_programs_do(path: Path, mesh: TriangleMesh, *, sides: int) -> Path:
    """Write an OBJ as collections of models for drawing have them: groups, materials, a normal for each face."""
    lines = ["mtllib not_there.mtl", *(f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices.tolist())]
    faces = mesh.faces.tolist()
    normals = mesh.face_normals()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals.tolist()]
    for i, face in enumerate(faces):
        if i % 100 == 0:
            lines += [f"g piece{i}", f"usemtl colour{i}"]
        lines += ["f " + " ".join(f"{v + 1}//{i + 1}" for v in way) for way in (face, face[::-1])[:sides]]
    path.write_text("\n".join(lines) + "\n")
    return path


SHADE = primitives.height_field(np.zeros((5, 7)), 10e-3)
LID = TriangleMesh(SHADE.vertices, SHADE.faces[SHADE.face_normals()[:, 2] > 0.0])


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("sides", [1, 2])
def test_a_sheet_of_a_drawing_program_can_be_touched_from_both_sides(tmp_path: Path, side: float, sides: int) -> None:
    path = as_drawing_programs_do(tmp_path / "sheet.obj", LID, sides=sides)
    with pytest.raises(ConfigError, match="does not enclose a volume"):
        load_mesh(path, "m", repair=False)
    mesh = load_mesh(path, "m", repair=True)
    assert what_is_open(mesh) == ""
    height = float(LID.vertices[:, 2].max())
    found = MeshShape(mesh, 0.5).nearest(np.array([3e-3, 4e-3, height + side * 17e-3]))
    assert found.distance_m == pytest.approx(17e-3, abs=0.11e-3)
    assert found.normal == pytest.approx([0.0, 0.0, side], abs=1e-6)


def test_an_obj_of_quads_with_normals_is_the_mesh_of_its_triangles(tmp_path: Path) -> None:
    corners = primitives.box(np.array([0.06, 0.05, 0.04])).vertices
    corners = np.unique(corners.round(9), axis=0)
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners.tolist()] + ["vn 0 0 1"]
    lines += ["f " + " ".join(f"{v}//1" for v in quad) for quad in quads]
    (tmp_path / "box.obj").write_text("\n".join(lines) + "\n")
    mesh = load_mesh(tmp_path / "box.obj", "m", repair=False)
    assert len(mesh.faces) == 12
    assert volume_m3(mesh) == pytest.approx(0.06 * 0.05 * 0.04)


def test_an_ascii_stl_in_inches_is_as_large_as_the_binary_one_in_millimetres(tmp_path: Path) -> None:
    made = trimesh.Trimesh(BALL.vertices / 25.4e-3, BALL.faces, process=False)
    (tmp_path / "ball.stl").write_text(trimesh.exchange.stl.export_stl_ascii(made))
    mesh = load_mesh(tmp_path / "ball.stl", "inch", repair=False)
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(0.08, abs=1e-5)


def both(one: TriangleMesh, other: TriangleMesh) -> TriangleMesh:
    faces = np.concatenate([one.faces, other.faces + len(one.vertices)])
    return TriangleMesh(np.concatenate([one.vertices, other.vertices]), faces)


def test_solids_that_reach_into_each_other_are_named_and_made_one_by_a_repair(tmp_path: Path) -> None:
    beside = TriangleMesh(BALL.vertices + np.array([0.05, 0.0, 0.0]), BALL.faces)
    path = export(tmp_path / "two.stl", both(BALL, beside))
    with pytest.raises(ConfigError, match="reach into each other") as caught:
        load_mesh(path, "mm", repair=False)
    assert (caught.value.key, caught.value.hint) == ("file", "`repair: true` makes them one")
    joined = load_mesh(path, "mm", repair=True)
    assert not what_is_open(joined)
    lens_m3 = volume_m3(TriangleMesh(BALL.vertices, BALL.faces)) * (1.0 - 0.625) ** 2 * (2.0 + 0.625) / 2.0
    assert volume_m3(joined) == pytest.approx(2.0 * volume_m3(BALL) - lens_m3, rel=0.01)


def test_cavities_are_kept_and_a_solid_that_is_inside_out_beside_a_larger_one_is_named(tmp_path: Path) -> None:
    small = TriangleMesh(0.5 * BALL.vertices, np.ascontiguousarray(BALL.faces[:, ::-1]))
    hollow = load_mesh(export(tmp_path / "hollow.stl", both(BALL, small)), "mm", repair=False)
    assert volume_m3(hollow) == pytest.approx(0.875 * volume_m3(BALL))
    beside = TriangleMesh(small.vertices + np.array([0.07, 0.0, 0.0]), small.faces)
    path = export(tmp_path / "beside.stl", both(BALL, beside))
    with pytest.raises(ConfigError, match="inside out"):
        load_mesh(path, "mm", repair=False)
    assert volume_m3(load_mesh(path, "mm", repair=True)) == pytest.approx(1.125 * volume_m3(BALL))


@pytest.mark.parametrize(("beside", "creases"), [((40, 0, 0), 16), ((40, 40, 0), 24)], ids=["a wall", "an edge"])
def test_solids_that_share_a_wall_or_an_edge_are_closed_by_a_repair(
    tmp_path: Path, beside: tuple[float, float, float], creases: int
) -> None:
    box = primitives.box(np.array([0.04, 0.04, 0.02]))
    path = export(tmp_path / "two.stl", both(box, TriangleMesh(box.vertices + MM * np.array(beside), box.faces)))
    with pytest.raises(ConfigError, match="edges of more than two faces"):
        load_mesh(path, "mm", repair=False)
    made = load_mesh(path, "mm", repair=True)
    assert not what_is_open(made)
    assert volume_m3(made) == pytest.approx(64e-6)
    # Without those of the seam, whose two sides lie in one plane.
    assert len(MeshShape(made, 0.5).edges) == creases


def box_from(low_mm: tuple[float, ...], high_mm: tuple[float, ...]) -> TriangleMesh:
    low, high = MM * np.array(low_mm), MM * np.array(high_mm)
    made = primitives.box(high - low)
    return TriangleMesh(made.vertices - made.vertices.min(axis=0) + low, made.faces)


PLATE = box_from((-40, -40, 17.5), (40, 40, 20))
POST = box_from((20, -5, 0), (40.05, 5, 17.5))


@pytest.mark.parametrize("left_out", [False, True], ids=["part by part", "equal faces once"])
def test_parts_of_an_assembly_that_overlap_with_equal_faces_are_made_one_by_a_repair(
    tmp_path: Path, left_out: bool
) -> None:
    lower = box_from((20, -5, 0), (40.05, 5, 10))
    faces = both(both(PLATE, lower), POST)
    merged = trimesh.Trimesh(faces.vertices, faces.faces, process=False)
    merged.merge_vertices()
    if left_out:
        _, first = np.unique(np.sort(merged.faces, axis=1), axis=0, return_index=True)
        merged.update_faces(np.isin(np.arange(len(merged.faces)), first))
    path = export(tmp_path / "assembly.ply", TriangleMesh(np.asarray(merged.vertices), np.asarray(merged.faces)))
    with pytest.raises(ConfigError, match="edges of more than two faces"):
        load_mesh(path, "mm", repair=False)
    made = load_mesh(path, "mm", repair=True)
    assert not what_is_open(made)
    assert volume_m3(made) == pytest.approx(volume_m3(PLATE) + volume_m3(POST), rel=1e-4)


def test_the_face_with_which_a_solid_stands_against_another_is_no_edge(tmp_path: Path) -> None:
    inside = TriangleMesh(POST.vertices - MM * np.array([20.0, 0.0, 0.0]), POST.faces)
    made = load_mesh(export(tmp_path / "touching.stl", both(PLATE, inside)), "mm", repair=False)
    upwards = MeshShape(made, 0.5).edges.middle_normals[..., 2].max(axis=1) > 0.5
    heights = MeshShape(made, 0.5).edges.starts[upwards][:, 2]
    assert heights == pytest.approx(np.full(4, 20 * MM))


@pytest.mark.parametrize("y_mm", [-8.0, -5.0, 0.0, 3.0])
def test_a_ledge_that_juts_out_a_little_under_an_edge_is_not_what_the_tip_follows(tmp_path: Path, y_mm: float) -> None:
    made = load_mesh(export(tmp_path / "ledge.stl", both(PLATE, POST)), "mm", repair=False)
    apex = MM * np.array([40.2, y_mm, 17.0])
    found = MeshShape(made, 0.5).edges.nearest(apex, np.array([0.0, 0.0, 1.0]))
    assert found.point == pytest.approx(MM * np.array([40.0, y_mm, 20.0]))


def test_a_closed_shell_whose_faces_lie_back_to_back_is_one_solid(tmp_path: Path) -> None:
    made = load_mesh(as_drawing_programs_do(tmp_path / "shell.obj", BALL, sides=2), "m", repair=True)
    assert not what_is_open(made)
    assert len(made.faces) == len(BALL.faces)
    assert volume_m3(made) == pytest.approx(volume_m3(BALL), rel=1e-3)


def test_check_says_where_long_faces_leave_a_bend_to_guesses(tmp_path: Path) -> None:
    notes = {}
    for name, rows in (("fan", 3), ("fine", 30)):
        x, y = (np.linspace(-0.06, 0.06, count) for count in (60, rows))
        made = primitives.height_field(0.5 * (x[None] ** 2 - y[:, None] ** 2) / 0.1, 0.12 / 59)
        stretched = made.vertices * np.array([1.0, 59.0 / (rows - 1), 1.0])
        export(tmp_path / f"{name}.stl", TriangleMesh(stretched, made.faces))
        (tmp_path / f"{name}.yaml").write_text(CELL.format(file=f"{name}.stl", unit="mm\n      repair: true"))
        notes[name] = " ".join(plan_cell(tmp_path / f"{name}.yaml").notes)
    assert "edges of up to 63 mm over a bend" in notes["fan"]
    assert "`crease_deg: 0`" in notes["fan"]
    assert "over a bend" not in notes["fine"]


def test_check_says_what_a_repair_left_open(tmp_path: Path) -> None:
    export(tmp_path / "cup.stl", without(BALL, 24))
    (tmp_path / "c.yaml").write_text(CELL.format(file="cup.stl", unit="mm\n      repair: true"), encoding="utf-8")
    notes = plan_cell(tmp_path / "c.yaml").notes
    assert any("the repair left" in note and "edges of one face only" in note for note in notes), notes
