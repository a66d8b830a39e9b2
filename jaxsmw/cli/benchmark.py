"""`jaxsmw benchmark`: match and measure many pairs of a data set."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from jaxsmw.benchmark.datasets import DataPair, DataSet, choose_pairs
from jaxsmw.benchmark.opponents.registry import METHODS, PEERS
from jaxsmw.benchmark.protocols import PROTOCOLS, protocol_pairs
from jaxsmw.choices import DEFAULT_INITIAL_MAP, DEFAULT_MATCH_INIT, MatchInit, Template
from jaxsmw.cli.arguments import add_paths, add_processes, add_seed, option_of, path, whole_number
from jaxsmw.cli.console import report_progress, show
from jaxsmw.cli.interruption import announce_consequence, quiet_children
from jaxsmw.cli.outputs import check_outputs
from jaxsmw.errors import InputError
from jaxsmw.runtime.files import make_directory
from jaxsmw.wording import count_of

HELP = "match many pairs of a data set and measure the errors; an interrupted run can be continued"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "data",
        metavar="DATASET_DIRECTORY",
        type=path,
        help="directory of a data set in its published layout: FAUST, SCAPE, TOSCA, a SHREC set, "
        "PARTIALSMAL, CP2P24 or a remeshed set",
    )
    parser.add_argument(
        "--methods",
        metavar="METHOD",
        type=path,
        nargs="+",
        help="methods to measure (default: all methods that suit the pairs): "
        f"{', '.join(METHODS)}; {', '.join(PEERS)} if these libraries are installed. For a method of another "
        "program, give the directory of its maps, in files named X_Y.map. "
        "cpd and smooth-shells take 20 to 30 seconds per pair. pfm matches partial shapes only. "
        "accurate:TEMPLATE is accurate through a template, which is a mesh file or one of "
        f"{', '.join(get_args(Template))}",
    )
    pairs = parser.add_mutually_exclusive_group()
    pairs.add_argument(
        "--pairs",
        metavar="N|FILE",
        type=path,
        help="number of random pairs, or a file that lists pairs (default: all pairs)",
    )
    pairs.add_argument(
        "--protocol",
        metavar="NAME",
        choices=list(PROTOCOLS),
        help="the pairs on which papers report errors: %(choices)s. The data set must be complete",
    )
    add_paths(
        parser,
        {
            "--init INITIAL_MAP": f"initial map of all methods: {', '.join(get_args(MatchInit))}, or a "
            f"directory with maps in files named X_Y.map (default: {DEFAULT_MATCH_INIT}). With "
            f"{DEFAULT_MATCH_INIT}, all methods start from {DEFAULT_INITIAL_MAP}, and accurate also from "
            "aligned if the shapes are asymmetric"
        },
    )
    parser.add_argument(
        "--mirrored",
        action="store_true",
        help="measure each map against the ground truth or the mirrored ground truth, whichever is closer",
    )
    parser.add_argument(
        "--evaluation-samples",
        metavar="N",
        type=whole_number(1),
        help="number of random points at which errors are measured (default: all points)",
    )
    add_seed(parser, "seed for the random choice of pairs and points")
    add_paths(
        parser,
        {
            "--output DIR": "directory for results, tables and figures (default: jaxsmw-benchmark-NAME, "
            "where NAME is the name of the data set)",
            "--verify RESULTS.CSV": "measure a random tenth of the pairs in this file again, with all its "
            "methods or with --methods, and compare the errors; nothing is stored",
        },
    )
    parser.add_argument(
        "--describe",
        action="store_true",
        help="match nothing, and print a table of how many pairs have shapes that are rotated against each "
        "other, of different scale, or triangulated differently",
    )
    add_processes(
        parser,
        default=os.cpu_count() or 1,
        purpose="number of worker processes, each on one core; measured times are most accurate with one "
        "process (default: %(default)s, the number of cores)",
    )


def run(options: argparse.Namespace) -> None:
    """Match and measure all pairs that have no results yet, then write and print the tables of all pairs.

    With `--verify`, measure a tenth of stored results again instead, and print a comparison. With
    `--describe`, match nothing, and print how the shapes of the pairs differ.

    **Raises:** `InputError` if an option cannot be used or a needed package is not installed. If a pair
    cannot be measured, `InputError` is raised after the results of all other pairs are written.
    `ArithmeticError` if stored results do not hold.
    """
    if options.describe:
        _describe(options)
        return
    from jaxsmw.report.figures import check_drawable

    check_drawable()
    try:
        import pyarrow  # noqa: F401 (the tables of all pairs need it, and they are written last)

        import jaxsmw.benchmark.benchmark  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(
            f"benchmarks need {error.name}, which is not installed: install it with pip install "
            "'jaxsmw[benchmark]'."
        ) from error
    if options.verify is None:
        _measure(options)
    else:
        _verify(options)


def _measure(options: argparse.Namespace) -> None:
    from jaxsmw.benchmark.benchmark import run_benchmark
    from jaxsmw.benchmark.datasets import open_data_set
    from jaxsmw.benchmark.measurement import Settings
    from jaxsmw.benchmark.opponents.registry import find_methods, suited_methods
    from jaxsmw.benchmark.tables import markdown_table, share_of_pairs, write_tables
    from jaxsmw.runtime.workers import open_executor

    data_set = open_data_set(options.data)
    pairs = _chosen_pairs(data_set, options)
    init = options.init or DEFAULT_MATCH_INIT
    settings = Settings(init, options.mirrored, options.evaluation_samples, options.seed)
    methods = find_methods(options.methods) if options.methods else suited_methods(pairs)
    output = options.output or f"jaxsmw-benchmark-{data_set.name}"
    check_outputs([options.pairs], directories=[(output, ())])
    if Path(output).resolve() == data_set.directory.resolve():
        raise InputError(f"{output}: is the directory of the data set: choose another directory.")
    directory = make_directory(output)
    share = share_of_pairs(data_set, {pair.names for pair in pairs})
    report_progress(f"{data_set.layout}, {share}")
    announce_consequence(f"finished pairs are kept in {output}, and the same command continues from there")
    with quiet_children(), open_executor(options.workers, options.scheduler) as executor:
        results = run_benchmark(data_set, pairs, directory, methods, settings, executor, quiet=options.quiet)
    if results.rows:
        show(markdown_table(write_tables(directory, data_set, results, settings, methods)).rstrip("\n"))
    report_progress(f"the results are in {output}")
    results.check()


def _chosen_pairs(data_set: DataSet, options: argparse.Namespace) -> list[DataPair]:
    if options.protocol is None:
        return choose_pairs(data_set, options.pairs, options.seed)
    return protocol_pairs(options.protocol, data_set)


def _refuse(options: argparse.Namespace, names: Sequence[str], reason: str) -> None:
    """Raise `InputError` if one of the options is given, although it has no effect."""
    for name in names:
        if getattr(options, name) not in (None, False):
            raise InputError(f"{reason}, so {option_of(name)} has no effect: leave it out.")


def _describe(options: argparse.Namespace) -> None:
    from tqdm import tqdm

    from jaxsmw.benchmark.datasets import open_data_set
    from jaxsmw.benchmark.differences import compare_shapes, differences_row
    from jaxsmw.benchmark.tables import markdown

    without_effect = ("methods", "init", "mirrored", "evaluation_samples", "output", "verify")
    _refuse(options, without_effect, "--describe matches nothing")
    data_set = open_data_set(options.data)
    pairs = _chosen_pairs(data_set, options)
    progress = tqdm(pairs, unit="pair", disable=options.quiet)
    differences = [compare_shapes(*pair.read()) for pair in progress]
    header = ["set", "layout", "rotated", "rescaled", "re-triangulated", "papers"]
    row = [data_set.name, data_set.layout, *differences_row(differences), data_set.papers]
    show(markdown([header, row]).rstrip("\n"))


def _verify(options: argparse.Namespace) -> None:
    from jaxsmw.benchmark.datasets import open_data_set
    from jaxsmw.benchmark.opponents.registry import find_methods, known_methods
    from jaxsmw.benchmark.tables import markdown
    from jaxsmw.benchmark.verification import StoredResults
    from jaxsmw.runtime.workers import open_executor

    without_effect = ("pairs", "protocol", "mirrored", "evaluation_samples", "output")
    _refuse(options, without_effect, "--verify uses the settings of the stored results")
    data_set = open_data_set(options.data)
    stored = StoredResults(Path(options.verify), options.init)
    pairs = stored.draw(data_set, options.seed)
    methods = find_methods(stored.chosen_methods(options.methods, known_methods()))
    report_progress(f"{data_set.layout}: measuring {count_of(len(pairs), 'stored pair')} again")
    announce_consequence("the stored results are unchanged")
    with quiet_children(), open_executor(options.workers, options.scheduler) as executor:
        comparisons = stored.measure_again(data_set, pairs, methods, executor, quiet=options.quiet)
    rows = [["method", "errors", "equal", "that hold", "largest difference x10^-3"]]
    for name in methods:
        own = [error for error in comparisons if error.method == name]
        equal, hold = sum(error.difference == 0 for error in own), sum(error.holds for error in own)
        largest = max((error.difference for error in own), default=0.0)
        rows.append([name, str(len(own)), str(equal), str(hold), f"{1000 * largest:.3g}"])
    show(markdown(rows))
    if wrong := [error for error in comparisons if not error.holds]:
        worst = max(wrong, key=lambda error: error.difference)
        raise ArithmeticError(
            f"{options.verify}: {len(wrong)} of {len(comparisons)} errors do not hold. The largest "
            f"difference is that of {worst.method} on {worst.source} to {worst.target}: {worst.stored:.4f} "
            f"is stored, and {worst.measured:.4f} was measured now."
        )
    show(f"All {len(comparisons)} errors hold: they differ by at most 2 %, or by at most 0.0005.")
