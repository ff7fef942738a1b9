"""``train``, ``train-sim``, ``train-check``, ``calibrate``, ``calibrate-sim``, ``adapt``, ``evaluate``: estimators."""

from __future__ import annotations

import argparse
import math
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

from touchcell.cell.cli.arguments import Subparsers, add_command, depth, positive, whole
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.cli.sim_recipes import DEEPEST_MM, PRESETS, SimRecipe
from touchcell.cell.cli.workers import add_workers, workers_of
from touchcell.cell.config.find import find_cell
from touchcell.progress import shown_progress

_SIMULATED_KINDS = ("gdn", "cnn", "markers")
_TRAINING_LIMIT_S = 86_400
_NAMED = 5
_CANDIDATES = {
    "mean": "mean of the labels",
    "affine": "affine map",
    "transfer": "Gaussian processes",
    "scratch": "trained from scratch",
}


def add_parser(commands: Subparsers) -> None:
    """Declare the commands."""
    _add_training(commands)
    _add_calibration(commands)
    evaluate = add_command(commands, "evaluate", _evaluate, "measure error, likelihood and latency on labelled images")
    _add_data(evaluate, "data set folder with train/, val/ or test/")
    evaluate.add_argument("--split", choices=("train", "val", "test"), default="val", help="(default: %(default)s)")
    evaluate.add_argument("--model", type=_model, required=True, metavar="FILE", help="model file")
    evaluate.add_argument("--calibration", type=Path, metavar="FILE", help="file of `touchcell calibrate`")
    evaluate.add_argument("--deeper-than", type=float, metavar="MM", help="leave out shallower contacts")
    evaluate.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")


def _add_training(commands: Subparsers) -> None:
    train = add_command(commands, "train", _train, "train an estimator on labelled images")
    train.add_argument(
        "--data", type=Path, nargs="+", required=True, metavar="DIR", help="data set folder with train/ and val/"
    )
    _add_out(train, "model file to write (.safetensors); of several trainings the folder for them")
    train.add_argument(
        "--kind",
        nargs="+",
        default=["gdn"],
        metavar="TRAINER",
        help="such as gdn, cnn or markers, see `touchcell list` (default: gdn)",
    )
    train.add_argument(
        "--seeds", metavar="FIRST..LAST", help="a training for each seed, kind and data set, and a table"
    )
    train.add_argument("--epochs", type=positive, help="passes over the images (default: the kind's own)")
    train.add_argument(
        "--rings", type=positive, help="of a marker estimator's lattice (default: counted in the images)"
    )
    train.add_argument("--networks", type=positive, help="of a marker estimator, whose mixture it gives (default: 2)")
    train.add_argument(
        "--short-side",
        type=positive,
        metavar="PX",
        help="least pixels of what a gdn or cnn sees, made by averaging whole ones (default: 100; 70 is twice as fast)",
    )
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another setting, see `touchcell describe trainer TRAINER`",
    )
    _add_seed(train)
    train.add_argument("--fresh", action="store_true", help="start again instead of resuming")
    add_workers(train, time_limit_s=_TRAINING_LIMIT_S, what="training")

    train_sim = add_command(commands, "train-sim", _train_sim, "train the estimator that ships, on simulated images")
    _add_out(train_sim, "model file to write (.safetensors)")
    train_sim.add_argument(
        "--preset",
        choices=tuple(PRESETS),
        help="settings with which that model that ships was made; options beside it take the place of its own",
    )
    train_sim.add_argument("--samples", type=positive, help="simulated images (default: 12000)")
    train_sim.add_argument("--kind", choices=_SIMULATED_KINDS, help="as of `train` (default: gdn)")
    train_sim.add_argument("--tip", metavar="TIP", help="tip file of `calibrate-sim`, or the name of one that ships")
    train_sim.add_argument("--processed", action="store_true", help="for images as the public data have them")
    train_sim.add_argument(
        "--feature",
        choices=("surface", "edge", "kinds"),
        help="what is touched; kinds: a classifier that tells nothing, surface, edge and corner (default: surface)",
    )
    train_sim.add_argument(
        "--feels", choices=("plane", "shape"), help="surfaces to press on: planes, or such as bend (default: plane)"
    )
    train_sim.add_argument(
        "--tips",
        choices=("one", "spread"),
        help="sensors: about one tip, or on surfaces as sensors of a kind differ (default: one)",
    )
    train_sim.add_argument("--deepest-mm", type=depth, metavar="MM", help=f"largest depth (default: {DEEPEST_MM:g})")
    train_sim.add_argument("--epochs", type=positive, help="passes over the images (default: the kind's own)")
    _add_seed(train_sim)

    check = add_command(
        commands, "train-check", _train_check, "learn which images an image network must refuse; the network stays"
    )
    check.add_argument("--model", type=_model, required=True, metavar="FILE", help="model file of a gdn or cnn")
    _add_out(check, "model file to write (.safetensors)")
    check.add_argument("--data", type=Path, metavar="DIR", help="its data set (default: images as of train-sim)")
    check.add_argument(
        "--samples", type=positive, default=6000, help="simulated images, without --data (default: %(default)s)"
    )
    _add_seed(check)


def _add_calibration(commands: Subparsers) -> None:
    calibrate_sim = add_command(commands, "calibrate-sim", _calibrate_sim, "make the simulated tip like a real one")
    _add_data(calibrate_sim, "data set folder with train/, better also val/")
    _add_out(calibrate_sim, "tip file to write (.yaml)")
    calibrate_sim.add_argument(
        "--frames", type=positive, default=20, help="labelled images to fit to (default: %(default)s)"
    )
    calibrate_sim.add_argument(
        "--images", type=positive, default=600, help="images that teach the matching, unlabelled (default: %(default)s)"
    )
    calibrate_sim.add_argument(
        "--rings", type=positive, default=10, help="of the marker lattice (default: %(default)s)"
    )
    _add_seed(calibrate_sim)

    calibrate = add_command(
        commands, "calibrate", _calibrate, "find zoom, turn and shift of a camera from images out of contact"
    )
    calibrate.add_argument("--model", type=_model, required=True, metavar="FILE", help="model file")
    _add_out(calibrate, "calibration file to write (.yaml)")
    source = calibrate.add_mutually_exclusive_group(required=True)
    source.add_argument("--frames", type=Path, metavar="DIR", help="folder with images of the tip out of contact")
    source.add_argument("--cell", type=Path, metavar="CELL", help="cell file whose sensor takes them now")
    calibrate.add_argument("--sensor", metavar="NAME", help="which sensor of the cell (default: its only one)")
    calibrate.add_argument(
        "--count", type=positive, default=20, help="images that the cell's sensor takes (default: %(default)s)"
    )
    calibrate.add_argument(
        "--reference", type=Path, metavar="DIR", help="such images of the sensor that the model knows"
    )

    adapt = add_command(
        commands, "adapt", _adapt, "bring a marker estimator to another sensor by a few labelled images"
    )
    adapt.add_argument("--model", type=_model, required=True, metavar="FILE", help="model file of a marker estimator")
    _add_data(adapt, "data set folder with train/ of the new sensor")
    adapt.add_argument("--frames", type=positive, help="so many of its images, evenly over the depths (default: all)")
    _add_out(adapt, "model file to write (.safetensors)")


def _add_data(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help=text)


def _add_out(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=text)


def _add_seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=whole, default=0, help="of everything random (default: %(default)s)")


def _train(options: argparse.Namespace) -> int:
    from touchcell.cell.config.settings import parse_settings
    from touchcell.perception.networks.trainer import train

    named = {
        "epochs": options.epochs,
        "networks": options.networks,
        "rings": options.rings,
        "short_side_px": options.short_side,
    }
    settings = {**{key: value for key, value in named.items() if value is not None}, **parse_settings(options.set)}
    if options.seeds is not None or len(options.data) > 1 or len(options.kind) > 1:
        return _train_many(options, settings)
    train(
        options.data[0],
        options.out,
        kind=options.kind[0],
        seed=options.seed,
        resume=not options.fresh,
        settings=settings,
    )
    return EXIT_OK


def _train_many(options: argparse.Namespace, settings: dict[str, object]) -> int:
    from touchcell.cell.sweeps.factors import grid_values
    from touchcell.cell.trainings.trainings import train_all, trainings, trainings_table

    seeds = [options.seed] if options.seeds is None else grid_values("--seeds", options.seeds)
    wanted = trainings(options.kind, [path.absolute() for path in options.data], seeds, settings)
    done = train_all(wanted, options.out, workers=workers_of(options), executor=options.executor, live=True)
    text = trainings_table(done)
    print(text)
    (options.out / "summary.txt").write_text(text + "\n")
    return EXIT_TASK_FAILED if any(each.reason for each in done) else EXIT_OK


def _train_sim(options: argparse.Namespace) -> int:
    given = {
        each.name: value
        for each in fields(SimRecipe)
        # Of a flag that is not given, the default is False.
        if (value := getattr(options, each.name)) is not None and value is not False
    }
    recipe = replace(PRESETS[options.preset] if options.preset else SimRecipe(), **given)
    if recipe.feature == "kinds":
        from touchcell.cell.trainings.feature_kinds import train_kinds

        print(train_kinds(options.out, samples=recipe.samples, epochs=recipe.epochs, seed=recipe.seed))
        return EXIT_OK
    from touchcell.cell.cli.train_sim import train_on_simulation

    train_on_simulation(options.out, recipe)
    return EXIT_OK


def _train_check(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.train_check import train_check

    train_check(options.model, options.out, data=options.data, samples=options.samples, seed=options.seed)
    return EXIT_OK


def _calibrate_sim(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.calibrate_sim import calibrate_sim

    calibrate_sim(
        options.data,
        options.out,
        frames=options.frames,
        images=options.images,
        rings=options.rings,
        seed=options.seed,
    )
    return EXIT_OK


def _calibrate(options: argparse.Namespace) -> int:
    from touchcell.cell.cli.calibrate import calibrate

    change = calibrate(
        options.model,
        options.out,
        frames=options.frames,
        cell=None if options.cell is None else find_cell(options.cell),
        sensor=options.sensor,
        count=options.count,
        taught=options.reference,
    )
    u, v = change.shift_px
    print(
        f"zoom {change.zoom:.4f}, turn {change.turn_deg:.2f} deg, shift {u:.2f} {v:.2f} px, {change.rms_px:.2f} px left"
    )
    print(f"{change.frames} images; wrote {options.out}")
    return EXIT_OK


def _model(name: str) -> Path:
    """Return the model file that a command line names, as a cell file would: a path, or ``builtin:NAME``."""
    from touchcell.perception.runtime.network_estimator import model_path

    return model_path(name)


def _adapt(options: argparse.Namespace) -> int:
    from touchcell.drivers.replay.dataset import REST_IMAGE
    from touchcell.perception.calibration.adaptation import adapt
    from touchcell.perception.models.labels import CONTACT_NAMES

    result = adapt(options.model, options.data, options.out, frames=options.frames)
    camera, convention = result.model.header.camera, result.convention
    assert camera is not None
    print(f"{result.matched} of {result.images} images matched and learned from")
    print(f"camera: zoom {camera.zoom:.4f}")
    print(
        f"labels: {'mirrored, ' if convention.mirrored else ''}"
        f"{'shear of the opposite sign, ' if convention.shear_reversed else ''}"
        f"tilt axes rotated by {math.degrees(convention.tilt_axes_rad):.0f} deg, "
        f"shear axes by {math.degrees(convention.shear_axes_rad):.0f} deg"
    )
    print("mean absolute error on left-out images: " + ", ".join(CONTACT_NAMES))
    for name, errors in result.left_out_mae.items():
        chosen = " (taken)" if name == result.method else ""
        print(f"  {_CANDIDATES[name]:<22}" + " ".join(f"{error:7.3f}" for error in errors) + chosen)
    for name in result.no_better:
        print(f"warning: {name} is estimated no better than by its mean; check its labels, or give more images")
    if result.doubtful:
        some = ", ".join(result.doubtful[:_NAMED]) + (", ..." if len(result.doubtful) > _NAMED else "")
        print(f"warning: depth or tilt is far off the label in {len(result.doubtful)} images; check the rows of {some}")
    for region in result.missing:
        print(f"warning: no image with {region}")
    if result.model.reference is None:
        print(f"warning: {options.data} has no {REST_IMAGE}, an image out of contact; a cell's contact gate needs one")
    print(f"wrote {options.out}")
    return EXIT_OK


def _evaluate(options: argparse.Namespace) -> int:
    from touchcell.perception.networks.evaluate import evaluate, print_table

    with shown_progress() as show:
        result = evaluate(
            options.data,
            options.split,
            options.model,
            calibration=options.calibration,
            deeper_than_mm=options.deeper_than,
            progress=partial(show, "images"),
        )
    print_table(result)
    if options.json is not None:
        result.write(options.json)
    return EXIT_OK
