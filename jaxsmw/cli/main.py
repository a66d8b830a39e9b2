"""The command line. Heavy imports wait until a command needs them."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from jaxsmw.errors import InputError
from jaxsmw.runtime.files import atomic_write, check_directory, check_writable, make_directory

if TYPE_CHECKING:
    from jaxsmw.core.banks import FilterBank
    from jaxsmw.core.solutions import Solution
    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.evaluation.metrics import GeodesicError
    from jaxsmw.geometry.mesh import Mesh
    from jaxsmw.matching import Correspondence


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run `jaxsmw`. Exits with 0 if all went well, 2 for bad input, 1 for anything else."""
    parser = _parser()
    options = parser.parse_args(arguments)
    _make_interruptible()
    logger = logging.getLogger("jaxsmw")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.WARNING if options.quiet else logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: _say(f"warning: {message}")
            from jaxsmw.runtime.cache import keep_programs

            keep_programs()
            options.run(options)
    except InputError as error:
        _say(f"jaxsmw: {error}")
        sys.exit(2)
    except ArithmeticError as error:
        _say(f"jaxsmw: {error}")
        sys.exit(1)
    except KeyboardInterrupt:
        _leave_at_once()
    except BrokenPipeError:
        # Whoever read our output has gone; Python would complain again when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    sys.exit(0)


def _leave_at_once() -> NoReturn:
    """End the process without waiting, as `sys.exit` would, for computations still under way."""
    print("jaxsmw: interrupted; files are written whole or not at all.", file=sys.stderr, flush=True)
    if threading.current_thread() is threading.main_thread():
        # A shell's loop ends only if what it runs dies of the signal.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)
    os._exit(128 + signal.SIGINT)


def _make_interruptible() -> None:
    """Let Ctrl-C end the process also while it is inside compiled code, where Python cannot raise."""

    def wait_for_signal() -> None:
        os.read(waiting, 1)
        # Time enough for Python to raise KeyboardInterrupt and clean up, if it can.
        time.sleep(2)
        _leave_at_once()

    waiting, waking = os.pipe()
    os.set_blocking(waking, False)
    signal.set_wakeup_fd(waking, warn_on_full_buffer=False)
    threading.Thread(target=wait_for_signal, daemon=True).start()


def _say(message: str) -> None:
    print(message, file=sys.stderr)


class _Parser(argparse.ArgumentParser):
    def __init__(self, **settings: Any) -> None:
        # An abbreviation would mean something else once there are more options.
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        _say(f"{self.prog}: {message} (see {self.prog} --help)")
        sys.exit(2)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="jaxsmw",
        description="Which vertex of one shape is which vertex of the other? Give two triangle meshes (OFF, "
        "OBJ, PLY, STL or MATLAB's MAT) of the same kind of body in different poses.",
    )
    parser.add_argument("--version", action="version", version=f"jaxsmw {metadata.version('jaxsmw')}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    demo = commands.add_parser("demo", help="match two poses of a built-in creature and show the result")
    demo.add_argument(
        "--output", metavar="DIR", default="jaxsmw-demo", help="where to (default: %(default)s)"
    )
    demo.add_argument("--kind", default="quadruped", help="kind of creature (default: %(default)s)")
    demo.add_argument(
        "--vertices", type=_integer(1), default=5000, help="size of the meshes (default: %(default)s)"
    )
    demo.add_argument("--seed", type=_integer(0), default=0, help="another creature (default: %(default)s)")
    demo.set_defaults(partial=False, index_base=None)
    _add_method(demo)
    _add_common(demo, _demo)

    match = commands.add_parser("match", help="match two meshes")
    match.add_argument("source", metavar="SOURCE", help="the mesh whose vertices ask")
    match.add_argument("target", metavar="TARGET", help="the mesh whose vertices answer")
    match.add_argument(
        "--output",
        metavar="FILE",
        required=True,
        help="gets one target vertex per source vertex, one per line, counted from 0; or, with the suffix "
        ".npy, as an array for numpy.load; or, with .mat, as the column T12 for MATLAB, counted from 1",
    )
    match.add_argument(
        "--surface-points",
        metavar="FILE.baryc_gt",
        help="also gets for each source vertex a point between target vertices: a face, counted from 1, and "
        "barycentric weights for its corners",
    )
    match.add_argument(
        "--expected-error",
        metavar="FILE",
        help="also gets for each source vertex how far from the truth its match may be, in square roots "
        "of the target's area",
    )
    match.add_argument(
        "--one-to-one",
        metavar="FILE",
        help="also gets a map like that of --output in which no two source vertices share a target vertex; "
        "for shapes of the same triangulation, elsewhere it is much less accurate",
    )
    match.add_argument(
        "--texture",
        metavar="DIR",
        help="write both meshes there as OBJ files with one picture, projected on the target and carried to "
        "the source",
    )
    match.add_argument("--report", metavar="DIR", help="write pictures, a 3D page and a summary there")
    _add_up(match)
    match.add_argument(
        "--ground-truth",
        metavar="FILE",
        nargs="+",
        help="the true map, in one of the forms that evaluate takes; the error is printed before and after",
    )
    _add_partial(match)
    _add_method(match)
    _add_reading(match)
    _add_evaluation(match)
    _add_common(match, _match)

    evaluate = commands.add_parser("evaluate", help="measure a map against the truth")
    evaluate.add_argument("source", metavar="SOURCE", help="the source mesh")
    evaluate.add_argument("target", metavar="TARGET", help="the target mesh")
    evaluate.add_argument(
        "map",
        metavar="MAP",
        nargs="+",
        help="maps, one target vertex per line, or .npy files, or .mat files (from 1)",
    )
    evaluate.add_argument(
        "--ground-truth",
        metavar="FILE",
        nargs="+",
        required=True,
        help="target vertices, one per line; or two .vts files, of the source and of the target; or a "
        ".baryc_gt file; or a two-column file",
    )
    evaluate.add_argument("--output", metavar="FILE", help="write the figures as JSON, curves included")
    evaluate.add_argument("--figure", metavar="FILE", help="draw the correspondence quality curves")
    evaluate.add_argument(
        "--page",
        metavar="FILE.html",
        help="write an interactive page to switch between the maps, with their errors",
    )
    _add_partial(evaluate)
    _add_up(evaluate)
    _add_reading(evaluate)
    _add_evaluation(evaluate)
    _add_common(evaluate, _evaluate)

    benchmark = commands.add_parser(
        "benchmark", help="match and measure many pairs of a data set; goes on where it was interrupted"
    )
    benchmark.add_argument(
        "data", metavar="DATASET_DIRECTORY", help="FAUST, SCAPE, TOSCA, SHREC or a remeshed set, as published"
    )
    benchmark.add_argument(
        "--methods",
        metavar="METHOD",
        nargs="+",
        help="start, mwp, accurate, mwp-sampled, no-filter, icp, cpd, bcicp, pfm, zoomout, zoomout-sampled; "
        "pyfm-zoomout, geomfum-zoomout where these are installed; directories with maps X_Y.map made "
        "elsewhere (default: all that suit the pairs; cpd takes half a minute per pair, bcicp a quarter; "
        "pfm is for parts)",
    )
    benchmark.add_argument(
        "--pairs", metavar="N|FILE", help="so many at random, or those of a list (default: all)"
    )
    benchmark.add_argument(
        "--init",
        metavar="START",
        default="shot",
        help="where all methods start: shot, wks, hks, wavelet, functional, or a directory with maps X_Y.map "
        "(default: %(default)s)",
    )
    benchmark.add_argument(
        "--mirrored", action="store_true", help="take the mirrored truth where a map is nearer to it"
    )
    benchmark.add_argument(
        "--evaluation-samples", metavar="N", type=_integer(1), help="measure at N random points only"
    )
    benchmark.add_argument("--seed", type=_integer(0), default=0, help="of both draws (default: %(default)s)")
    benchmark.add_argument(
        "--output", metavar="DIR", help="gets tables and figures (default: jaxsmw-benchmark-NAME)"
    )
    where = benchmark.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=_integer(1), default=os.cpu_count() or 1,
        help="processes of one core each; times are cleanest with one (default: %(default)s)",
    )  # fmt: skip
    where.add_argument("--scheduler", metavar="ADDRESS", help="use the workers of a Dask cluster")
    _add_common(benchmark, _benchmark)

    spectrum = commands.add_parser("spectrum", help="inspect a mesh and its eigenbasis")
    spectrum.add_argument("mesh", metavar="MESH")
    spectrum.add_argument(
        "--eigenvectors", type=_integer(1), default=100, help="how many (default: %(default)s)"
    )
    spectrum.add_argument(
        "--output",
        metavar="FILE",
        help="write eigenvalues, eigenvectors and vertex_areas (area 1) as .npz; or as .mat a struct S with "
        "evals, evecs, A and surface",
    )
    _add_bank(spectrum)
    spectrum.add_argument("--figure", metavar="FILE", help="draw the filter bank over the eigenvalues")
    _add_eigenproblem(spectrum)
    _add_reading(spectrum, indices=False)
    spectrum.set_defaults(page=None)
    _add_common(spectrum, _spectrum)

    render = commands.add_parser("render", help="draw a mesh, or a correspondence by its colours")
    render.add_argument("source", metavar="SOURCE", help="the mesh, or the source mesh")
    render.add_argument("target", metavar="TARGET", nargs="?", help="the target mesh")
    render.add_argument(
        "map",
        metavar="MAP",
        nargs="*",
        help="the map, one target vertex per line, or a .npy file, or a .mat file (from 1); for a page also "
        "several",
    )
    render.add_argument(
        "--output",
        metavar="FILE",
        required=True,
        help="a picture (.png, .pdf, .svg); of a correspondence also an interactive page (.html)",
    )
    _add_partial(render)
    _add_up(render)
    _add_reading(render)
    _add_common(render, _render)
    return parser


def _integer(lowest: int) -> Any:
    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if value < lowest:
            raise argparse.ArgumentTypeError(f"{value} is too small: at least {lowest} is needed")
        return value

    return convert


def _add_method(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("method")
    group.add_argument(
        "--init",
        metavar="START",
        default="shot",
        help="initial map: shot, wks, hks or wavelet descriptors, functional (the functional map that "
        "preserves shot), landmarks:FILE (a source and a target vertex per line) or map:FILE (default: "
        "%(default)s; it and what builds on it alone tell left from right)",
    )
    group.add_argument(
        "--preset",
        choices=("accurate", "paper", "fast"),
        help="how the map is refined: accurate; as the MWP paper has it, which is faster; or fast, the same "
        "on samples (default: accurate; paper where something is said with the options below)",
    )
    group.add_argument(
        "--precision", choices=("float32", "float64"), default="float32", help="(default: %(default)s)"
    )
    _add_eigenproblem(group)
    paper = parser.add_argument_group("the paper's method, changed")
    paper.add_argument("--eigenvectors", type=_integer(1), help="per shape (default: 100)")
    _add_bank(paper)
    paper.add_argument(
        "--solution",
        choices=("filtering", "least-squares", "least-squares-frobenius", "regularized"),
        help="how the functional map is found: filtering is for banks that are tight frames, least-squares "
        "is exact for all (-frobenius: with every vertex counting the same), regularized adds commutativity "
        "with the Laplacian and orthogonality (default: filtering)",
    )
    paper.add_argument("--iterations", type=_integer(1), help="(default: 3)")
    paper.add_argument(
        "--samples",
        metavar="N",
        type=_integer(1),
        help="iterate on N samples per shape; all in the last step",
    )
    paper.add_argument(
        "--search",
        choices=("auto", "exhaustive", "patches"),
        help="for nearest neighbours: exhaustive and patches find the same ones, patches faster on large "
        "meshes, and auto takes the faster (default: auto)",
    )
    paper.add_argument(
        "--stop-when-unchanged",
        action="store_true",
        default=None,
        help="end early when no match changes any more",
    )


# Options that change the paper's method.
_CHANGES = (
    "eigenvectors",
    "bank",
    "filters",
    "solution",
    "iterations",
    "samples",
    "search",
    "stop_when_unchanged",
)


# Names of banks on the command line, and their classes.
_BANKS = {
    "meyer": "Meyer",
    "simple-tight": "SimpleTight",
    "itersine": "Itersine",
    "half-cosine": "HalfCosine",
    "adapted-itersine": "Itersine",
    "adapted-half-cosine": "HalfCosine",
    "held": "Held",
    "simoncelli": "Simoncelli",
    "papadakis": "Papadakis",
    "regular": "Regular",
    "cubic-spline": "CubicSpline",
    "mexican-hat": "MexicanHat",
    "gabor": "Gabor",
    "identity": "Identity",
}
_DEFAULT_BANK = "meyer"
_NOT_TIGHT = ("cubic-spline", "mexican-hat", "gabor")


def _add_bank(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--bank",
        choices=tuple(_BANKS),
        metavar="BANK",
        help=f"the filters, one of {', '.join(_BANKS)} (default: {_DEFAULT_BANK})",
    )
    parser.add_argument(
        "--filters", type=_integer(2), help="how many, where the bank lets choose (default: 6)"
    )


def _add_eigenproblem(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--laplacian",
        choices=("auto", "cotangent", "robust"),
        default="auto",
        help="robust takes bad triangles; auto uses it where needed (default: %(default)s)",
    )
    parser.add_argument(
        "--eigensolver",
        choices=("auto", "exact", "approximate"),
        default="auto",
        help="approximate is within a few per mille of the eigenvalues, where triangles are even, and fast "
        "on large meshes (where it would be far off, exact takes over with a warning); auto uses it from "
        "50000 vertices on (default: %(default)s)",
    )


def _add_reading(parser: argparse.ArgumentParser, *, indices: bool = True) -> None:
    parser.add_argument("--weld", action="store_true", help="join vertices at exactly the same position")
    if indices:
        parser.add_argument(
            "--index-base",
            type=int,
            choices=(0, 1),
            help="number of the first vertex in map, landmark and ground-truth files (default: 0, and 1 in "
            ".mat, .vts, .baryc_gt and two-column ground-truth files)",
        )


def _add_evaluation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--evaluation-samples", metavar="N", type=_integer(1), help="measure at N random vertices only"
    )
    parser.add_argument("--seed", type=_integer(0), help="of --evaluation-samples (default: 0)")
    parser.add_argument(
        "--geodesics",
        choices=("strips", "exact"),
        help="strips is nearly always within 0.5 %% of exact, and much faster (default: strips)",
    )


def _add_partial(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--partial",
        action="store_true",
        help="one mesh shows only a part of the other's body, in the same unit of length",
    )


def _add_up(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--up",
        choices=("x", "y", "z", "-x", "-y", "-z"),
        help="the axis that points up in pictures (default: a guess); write --up=-z for -z",
    )


def _add_common(parser: argparse.ArgumentParser, run: Any) -> None:
    parser.add_argument("--quiet", action="store_true", help="no progress messages")
    parser.set_defaults(run=run)


def _benchmark(options: argparse.Namespace) -> None:
    from jaxsmw.report.figures import check_drawable

    check_drawable()
    try:
        from jaxsmw.evaluation.benchmark import Settings, run_benchmark
    except ModuleNotFoundError as error:
        raise InputError(
            f"benchmarks need {error.name}, which is not installed: pip install 'jaxsmw[benchmark]'"
        ) from error
    from jaxsmw.evaluation.datasets import choose_pairs, open_data_set
    from jaxsmw.evaluation.opponents.registry import find_methods, suited_methods
    from jaxsmw.evaluation.workers import open_executor
    from jaxsmw.report.tables import markdown_table, write_tables

    data_set = open_data_set(options.data)
    pairs = choose_pairs(data_set, options.pairs, options.seed)
    settings = Settings(options.init, options.mirrored, options.evaluation_samples, options.seed)
    methods = find_methods(options.methods) if options.methods else suited_methods(pairs)
    output = make_directory(options.output or f"jaxsmw-benchmark-{data_set.name}")
    logging.getLogger("jaxsmw").info(f"{data_set.layout}, {len(pairs)} of {len(data_set.pairs)} pairs")
    try:
        with open_executor(options.workers, options.scheduler) as executor:
            results = run_benchmark(data_set, pairs, output, methods, settings, executor)
    except KeyboardInterrupt:
        _say(f"what is finished is kept in {output}; the same command goes on from there.")
        raise
    if results.rows:
        print(markdown_table(write_tables(output, data_set, results, settings, methods)), end="")
    results.check()


def _demo(options: argparse.Namespace) -> None:
    from jaxsmw.report.figures import check_drawable

    check_drawable()
    from jaxsmw.evaluation.ground_truth import GroundTruth, write_ground_truth, write_pointwise_map
    from jaxsmw.geometry.creature import creature_pair
    from jaxsmw.io.mesh_files import write_mesh

    check_directory(options.output)
    logging.getLogger("jaxsmw").info("making the creature ...")
    pair = creature_pair(options.kind, vertices=options.vertices, seed=options.seed)
    truth = GroundTruth.of_all_vertices(pair.truth)
    options.evaluation_samples, options.geodesics, options.up = None, None, "y"
    correspondence = _run_match(options, pair.source, pair.target)
    directory = make_directory(options.output)
    write_mesh(directory / "source.off", pair.source)
    write_mesh(directory / "target.off", pair.target)
    write_ground_truth(directory / "truth.baryc_gt", truth, pair.target)
    write_pointwise_map(directory / "map.txt", correspondence.pointwise_map)
    _conclude(options, correspondence, truth, directory)
    print(f"Look at {directory / 'report.html'} and {directory / 'correspondence.png'}.")


def _match(options: argparse.Namespace) -> None:
    # What would fail after minutes of work should fail now.
    _, _, init_file = options.init.partition(":")
    measured = bool(options.ground_truth)
    _refuse_without_effect(options, "a --report", bool(options.report), "up")
    _refuse_without_effect(options, "--ground-truth", measured, "evaluation_samples", "geodesics")
    _refuse_without_effect(options, "--evaluation-samples", bool(options.evaluation_samples), "seed")
    read = measured or bool(init_file)
    _refuse_without_effect(options, "--ground-truth or a file of --init", read, "index_base")
    inputs = (options.source, options.target, init_file, *(options.ground_truth or ()))
    if options.report or options.texture:
        from jaxsmw.report.figures import check_drawable

        check_drawable()
    for path in _match_outputs(options):
        _keep_inputs(path, *inputs)
    files = options.output, options.surface_points, options.one_to_one, options.expected_error
    for path in filter(None, files):
        check_writable(path)
    from jaxsmw.evaluation.ground_truth import GroundTruth, write_ground_truth, write_pointwise_map

    mesh_x, mesh_y = _read(options.source, options), _read(options.target, options)
    if options.one_to_one:
        from jaxsmw.geometry.assignment import check_one_to_one

        check_one_to_one(int(mesh_x.used_vertices.sum()), int(mesh_y.used_vertices.sum()))
    truth = None
    if options.ground_truth:
        truth = _read_truth(options, mesh_x, mesh_y)
    for path in filter(None, (options.report, options.texture)):
        check_directory(path)
    correspondence = _run_match(options, mesh_x, mesh_y)
    directory = make_directory(options.report) if options.report else None
    textured = make_directory(options.texture) if options.texture else None
    write_pointwise_map(options.output, correspondence.pointwise_map)
    others: dict[str, Any] = {}
    if options.one_to_one:
        logging.getLogger("jaxsmw").info("one-to-one map ...")
        others["one-to-one"] = correspondence.one_to_one()
        write_pointwise_map(options.one_to_one, others["one-to-one"])
    if options.surface_points or textured:
        logging.getLogger("jaxsmw").info("points on the surface ...")
        points = correspondence.surface_points()
        if options.surface_points:
            others["surface"] = points
            write_ground_truth(options.surface_points, GroundTruth.of_all_vertices(points), mesh_y)
        if textured:
            from jaxsmw.report.texture import write_textured_pair

            write_textured_pair(textured, mesh_x, mesh_y, points)
    if options.expected_error:
        import numpy as np

        logging.getLogger("jaxsmw").info("expected error ...")
        with atomic_write(options.expected_error) as temporary:
            np.savetxt(temporary, correspondence.expected_error(), "%.6f")
    _conclude(options, correspondence, truth, directory, others)


def _run_match(options: argparse.Namespace, mesh_x: Mesh, mesh_y: Mesh) -> Correspondence:
    import jax

    from jaxsmw.matching import match

    with jax.enable_x64(options.precision == "float64"):
        return match(
            mesh_x,
            mesh_y,
            preset=_preset(options),
            init=_read_init(options, mesh_x, mesh_y),
            laplacian=options.laplacian,
            eigensolver=options.eigensolver,
            partial=options.partial,
        )


def _preset(options: argparse.Namespace) -> Any:
    """The name of a preset, or a stage where the paper's method is to be changed."""
    changes = [name for name in _CHANGES if getattr(options, name) is not None]
    # Written back for the report's summary.
    options.preset = options.preset or ("paper" if changes else "accurate")
    if not changes:
        return options.preset
    if options.preset != "paper":
        option = changes[0].replace("_", "-")
        raise InputError(
            f"--{option}: changes the paper's method, which --preset {options.preset} is not: leave one of "
            "them out."
        )
    from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
    from jaxsmw.presets import Stage

    chosen = {name: getattr(options, name) for name in changes}
    solution = chosen.get("solution", "filtering")
    if solution == "filtering" and options.bank in _NOT_TIGHT:
        _note_frame_bounds(options)
    refiner = WaveletPreservation(_bank(options), _solution(solution), search=chosen.get("search", "auto"))
    names = {"eigenvectors": "number_of_eigenvectors", "samples": "number_of_samples"}
    kept = ("eigenvectors", "samples", "iterations", "stop_when_unchanged")
    return Stage(refiner, **{names.get(name, name): chosen[name] for name in kept if name in chosen})


def _solution(name: str) -> Solution:
    from jaxsmw.core import solutions

    choices: dict[str, Solution] = {
        "filtering": solutions.Filtering(),
        "least-squares": solutions.LeastSquares(),
        "least-squares-frobenius": solutions.LeastSquares("frobenius"),
        "regularized": solutions.RegularizedLeastSquares(),
    }
    return choices[name]


def _note_frame_bounds(options: argparse.Namespace) -> None:
    import equinox as eqx
    import jax.numpy as jnp

    from jaxsmw.core.banks import frame_bounds

    # On evenly spaced eigenvalues, as those of a surface nearly are; one program instead of forty.
    lower, upper = eqx.filter_jit(frame_bounds)(_bank(options), jnp.arange(101.0), over="interval")
    _say(
        f"note: {options.bank} is no tight frame (bounds {lower:.2g} and {upper:.2g}), and filtering is "
        "meant for those; --solution least-squares is exact for any."
    )


def _conclude(
    options: argparse.Namespace,
    correspondence: Correspondence,
    truth: GroundTruth | None,
    directory: Path | None,
    others: Mapping[str, Any] | None = None,
) -> None:
    """Evaluate, print, and write the report, as far as each is wanted."""
    errors: dict[str, GeodesicError] = {}
    if truth is not None:
        # The last is the one whose errors the report shows.
        maps = {
            "initial": correspondence.initial_map,
            **(others or {}),
            "refined": correspondence.pointwise_map,
        }
        errors = _errors(options, correspondence.mesh_y, maps, truth)
    if directory is not None:
        from jaxsmw.report.summary import write_report

        logging.getLogger("jaxsmw").info("report ...")
        settings = {name: value for name, value in vars(options).items() if name != "run"}
        write_report(
            directory,
            correspondence,
            errors=errors,
            settings=settings,
            up=options.up,
        )
    for name, error in errors.items():
        print(f"{name + ' map:':12} {error}")
    times = ", ".join(f"{stage} {time:.2f} s" for stage, time in correspondence.seconds.items())
    print(f"time:        {times} (compilation included)")


def _refuse_without_effect(options: argparse.Namespace, what_for: str, is_given: bool, *names: str) -> None:
    """Refuse options that were given, though what they are for was not."""
    for name in names:
        if not is_given and getattr(options, name) is not None:
            option = name.replace("_", "-")
            raise InputError(f"--{option}: is for {what_for}: give that as well, or leave --{option} out.")


def _evaluate(options: argparse.Namespace) -> None:
    _refuse_without_effect(options, "--evaluation-samples", bool(options.evaluation_samples), "seed")
    _check_outputs(options, options.source, options.target, *options.map, *options.ground_truth)
    if options.page:
        from jaxsmw.report.figures import check_drawable

        if not _is_page(options.page):
            raise InputError(f"{options.page}: a page is written as .html; choose a name that ends in it.")
        check_drawable()
        check_writable(options.page)
    elif options.partial or options.up:
        raise InputError("--partial and --up are for --page: name a page, or leave them out.")

    mesh_x, mesh_y = _read(options.source, options), _read(options.target, options)
    truth = _read_truth(options, mesh_x, mesh_y)
    maps = _read_maps(options, mesh_x, mesh_y)
    errors = _errors(options, mesh_y, maps, truth)
    if options.page:
        _write_comparison(options.page, options, mesh_x, mesh_y, maps, errors)
    for name, error in errors.items():
        print(f"{name}: {error}")
    if options.figure:
        from jaxsmw.report.figures import save_figure
        from jaxsmw.report.summary import draw_errors

        save_figure(options.figure, draw_errors(errors))
    if options.output:
        results = {name: error.as_dictionary() for name, error in errors.items()}
        with atomic_write(options.output) as temporary:
            temporary.write_text(json.dumps(results, indent=2) + "\n", "utf-8")


def _is_page(path: str) -> bool:
    return Path(path).suffix.lower() in (".html", ".htm")


def _write_comparison(
    path: str,
    options: argparse.Namespace,
    mesh_x: Mesh,
    mesh_y: Mesh,
    maps: Mapping[str, Any],
    errors: Mapping[str, GeodesicError],
) -> None:
    from jaxsmw.report.summary import write_comparison

    # As short as tells them apart.
    for name in (lambda path: Path(path).stem, lambda path: Path(path).name, str):
        names = {path: name(path) for path in maps}
        if len(set(names.values())) == len(maps):
            break
    write_comparison(
        path,
        mesh_x,
        mesh_y,
        {names[path]: pointwise_map for path, pointwise_map in maps.items()},
        errors={names[path]: error for path, error in errors.items()},
        partial=options.partial,
        up=options.up,
    )


def _keep_inputs(output: str, *inputs: str) -> None:
    """Refuse to write over what is read."""
    if os.path.realpath(output) in (os.path.realpath(path) for path in inputs if path):
        raise InputError(f"{output}: is an input and would be overwritten: choose another name.")


def _match_outputs(options: argparse.Namespace) -> list[str]:
    """The files and directories that `match` writes, all different."""
    points = options.surface_points
    if points and Path(points).suffix != ".baryc_gt":
        raise InputError(f"{points}: points are written as .baryc_gt; choose a name that ends in it.")
    expected = options.expected_error
    if expected and Path(expected).suffix in (".npy", ".mat"):
        raise InputError(
            f"{expected}: expected errors are written as text; choose another name, such as .txt."
        )
    from jaxsmw.evaluation.ground_truth import check_map_name

    for path in filter(None, (options.output, options.one_to_one)):
        check_map_name(path)
    files = options.output, points, options.one_to_one, options.expected_error
    paths = [path for path in files if path]
    if options.texture:
        from jaxsmw.report.texture import TEXTURE_FILES

        paths += [os.path.join(options.texture, name) for name in ("", *TEXTURE_FILES)]
    if options.report:
        from jaxsmw.report.summary import REPORT_FILES

        inside = [os.path.join(options.report, name) for name in REPORT_FILES]
        # One directory may be for both.
        same = options.texture and os.path.realpath(options.report) == os.path.realpath(options.texture)
        paths += inside if same else [options.report, *inside]
    for position, path in enumerate(paths):
        if os.path.realpath(path) in map(os.path.realpath, paths[:position]):
            raise InputError(f"{path}: is another output as well: choose another name for one of them.")
    return paths


def _check_outputs(options: argparse.Namespace, *inputs: str) -> None:
    """Refuse what is read and places that cannot be written to before there is anything to write."""
    for output in filter(None, (options.output, options.figure, options.page)):
        _keep_inputs(output, *inputs)
    if options.output:
        check_writable(options.output)
    if options.figure:
        from jaxsmw.report.figures import check_figure_path

        check_figure_path(options.figure)


def _errors(
    options: argparse.Namespace, mesh_y: Mesh, maps: Mapping[str, Any], truth: GroundTruth
) -> dict[str, GeodesicError]:
    from jaxsmw.evaluation.metrics import geodesic_error

    logging.getLogger("jaxsmw").info("geodesic errors ...")
    return {
        name: geodesic_error(
            mesh_y,
            pointwise_map,
            truth,
            method=options.geodesics or "strips",
            number_of_samples=options.evaluation_samples,
            seed=options.seed or 0,
        )
        for name, pointwise_map in maps.items()
    }


def _spectrum(options: argparse.Namespace) -> None:
    _check_outputs(options, options.mesh)
    if options.output:
        from jaxsmw.io.exchange import check_spectrum_path

        check_spectrum_path(options.output)
    if not options.figure and (options.filters is not None or options.bank is not None):
        raise InputError("--bank and --filters are for --figure: name a figure, or leave them out.")
    bank = _bank(options)
    from jaxsmw.geometry.eigenbasis import as_spectrum, eigenpairs
    from jaxsmw.geometry.laplacian import choose_laplacian
    from jaxsmw.geometry.mesh import diagnose
    from jaxsmw.io.mesh_files import read_mesh

    mesh = read_mesh(options.mesh, weld=options.weld)
    laplacian = choose_laplacian(mesh) if options.laplacian == "auto" else options.laplacian
    pairs = eigenpairs(mesh, options.eigenvectors, laplacian=laplacian, eigensolver=options.eigensolver)
    eigenvalues = pairs[0]
    print("\n".join((*mesh.notes, *diagnose(mesh).sentences())))
    print(f"area {mesh.area:.6g}, {laplacian} Laplacian; eigenvalues of the surface scaled to area 1:")
    for start in range(0, len(eigenvalues), 10):
        row = " ".join(f"{value:9.2f}" for value in eigenvalues[start : start + 10])
        print(f"{start:5}  {row}")
    if options.output:
        import jax

        from jaxsmw.io.exchange import write_spectrum

        with jax.enable_x64(True):
            write_spectrum(options.output, as_spectrum(mesh, *pairs), mesh)
    if options.figure:
        from jaxsmw.report.figures import save_figure
        from jaxsmw.report.summary import draw_bank

        save_figure(options.figure, draw_bank(bank, eigenvalues))


def _render(options: argparse.Namespace) -> None:
    page = _is_page(options.output)
    if options.target and not options.map:
        raise InputError(f"{options.target}: to draw two meshes give the map between them as a third file.")
    if page and not options.map:
        raise InputError(
            f"{options.output}: a page shows a correspondence; give a target mesh and a map too."
        )
    if not page and len(options.map) > 1:
        raise InputError(
            f"{options.output}: a picture shows one map; leave {options.map[1]} out, or name a page (.html)."
        )
    if not page and options.partial:
        raise InputError(f"--partial: is for pages; leave it out, or write {options.output} as .html.")
    _refuse_without_effect(options, "a map", bool(options.map), "index_base")
    _keep_inputs(options.output, *filter(None, (options.source, options.target, *options.map)))
    from jaxsmw.report.figures import check_figure_path, draw_correspondence, draw_mesh, save_figure

    check = check_writable if page else check_figure_path
    check(options.output)
    mesh_x = _read(options.source, options)
    if not options.map:
        save_figure(options.output, draw_mesh(mesh_x, up=options.up))
        return
    mesh_y = _read(options.target, options)
    maps = _read_maps(options, mesh_x, mesh_y)
    if page:
        _write_comparison(options.output, options, mesh_x, mesh_y, maps, {})
    else:
        (pointwise_map,) = maps.values()
        save_figure(options.output, draw_correspondence(mesh_x, mesh_y, pointwise_map, up=options.up))


def _read(path: str, options: argparse.Namespace) -> Mesh:
    from jaxsmw.geometry.mesh import diagnose
    from jaxsmw.io.mesh_files import read_mesh

    mesh = read_mesh(path, weld=options.weld)
    if not options.quiet:
        for sentence in (*mesh.notes, *diagnose(mesh).sentences()):
            _say(f"{path}: {sentence}")
    return mesh


def _read_truth(options: argparse.Namespace, mesh_x: Mesh, mesh_y: Mesh) -> GroundTruth:
    from jaxsmw.evaluation.ground_truth import read_ground_truth

    for path in options.ground_truth:
        _index_base(path, options)
    return read_ground_truth(options.ground_truth, mesh_x, mesh_y, index_base=options.index_base)


def _read_maps(options: argparse.Namespace, mesh_x: Mesh, mesh_y: Mesh) -> dict[str, Any]:
    from jaxsmw.evaluation.ground_truth import read_pointwise_map

    return {
        path: read_pointwise_map(path, mesh_x, mesh_y, index_base=_index_base(path, options))
        for path in options.map
    }


def _index_base(path: str, options: argparse.Namespace) -> Any:
    """What a file counts from, where its form leaves it open; where nobody said it, the user is told."""
    from jaxsmw.io.mat_files import is_mat_file

    if options.index_base is None and is_mat_file(path):
        _say(f"note: {path} is read as MATLAB counts, from 1; if it counts from 0, add --index-base 0.")
    return options.index_base


def _read_init(options: argparse.Namespace, mesh_x: Mesh, mesh_y: Mesh) -> Any:
    from jaxsmw.evaluation.ground_truth import read_landmarks, read_pointwise_map

    kind, _, path = options.init.partition(":")
    if not path and kind in ("shot", "wks", "hks", "wavelet", "functional"):
        return kind
    if path and kind in ("landmarks", "map"):
        read = read_landmarks if kind == "landmarks" else read_pointwise_map
        return read(path, mesh_x, mesh_y, index_base=_index_base(path, options))
    raise InputError(
        f"--init {options.init}: is no initial map: choose shot, wks, hks, wavelet, functional, "
        "landmarks:FILE or map:FILE."
    )


def _bank(options: argparse.Namespace) -> FilterBank:
    from jaxsmw.core import banks

    name = options.bank or _DEFAULT_BANK
    kind = getattr(banks, _BANKS[name])
    if options.filters is None:
        bank = kind()
    elif "filters" not in kind.__dataclass_fields__:
        raise InputError(f"--filters: the number of filters of {name} is fixed; leave --filters out.")
    else:
        try:
            bank = kind(options.filters)
        except ValueError as error:
            raise InputError(f"--filters {options.filters}: {error}; ask for more.") from error
    if name.startswith("adapted-"):
        return banks.Warped(bank, banks.SpectralDistribution())
    return bank
