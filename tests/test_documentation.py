"""Code blocks in README and docs run from top to bottom, and the commands and options in them exist.

Notebooks run when the site is built (`.ci/run`). The build also checks names and links within the site.
"""

import argparse
import ast
import contextlib
import importlib
import inspect
import pkgutil
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import get_type_hints

import jax
import numpy as np
import pytest

import jaxsmw
from jaxsmw import RESULTS, creature_pair, geodesic_error, write_mesh
from jaxsmw.cli.run import make_parser
from jaxsmw.evaluation import GroundTruth

ROOT = Path(__file__).parents[1]
# The handwritten pages. Scripts generate all other pages.
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (
        ROOT / "README.md",
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("docs/how_to/*.md"),
        *ROOT.glob("docs/examples/*.md"),
    )
)
# The smallest number of refinements that the code of each page must compute.
REFINEMENTS = {
    "README.md": 1,
    "docs/frames.md": 3,
    "docs/exchange.md": 1,
    "docs/gradients.md": 1,
    "docs/how_to/gpu.md": 1,
    "docs/how_to/many_pairs.md": 1,
    "docs/how_to/parts.md": 2,
}


# Pages whose code takes longest, and which other tests run in large part.
LONGEST = {
    "docs/gradients.md",
    "docs/tutorial.md",
    "docs/tutorial_collection.md",
    "docs/how_to/match_collection.md",
    "docs/how_to/partial_shapes.md",
}


def code_blocks(page: str, language: str = "python") -> list[str]:
    text = (ROOT / page).read_text("utf-8")
    fences = re.findall(r"^( *)```(.*)\n((?:.*\n)*?)\1```$", text, flags=re.MULTILINE)
    return [
        re.sub(rf"^{indent}", "", block, flags=re.MULTILINE)
        for indent, kind, block in fences
        if kind == language
    ]


def commands(page: str) -> list[str]:
    """Return the lines that begin with `jaxsmw` or `python` in the code blocks of a page."""
    lines = "\n".join(code_blocks(page, "")) + "\n"
    lines += "\n".join(re.findall(r"^    (.+)$", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE))
    return [
        re.sub(r"\s+#.*", "", line) for line in lines.splitlines() if line.startswith(("jaxsmw ", "python "))
    ]


def mentioned_commands(page: str) -> list[str]:
    """Return the commands in the inline code of a page, with their options."""
    return re.findall(r"`(jaxsmw [a-z]+ [^`]+)`", (ROOT / page).read_text("utf-8"))


@pytest.fixture(scope="module")
def pair():
    return creature_pair(vertices=700)


@pytest.mark.parametrize(
    "page",
    [
        page
        if page == "README.md"
        else pytest.param(page, marks=pytest.mark.sampled if page in LONGEST else pytest.mark.slow)
        for page in PAGES
        if code_blocks(page) and not page.startswith("docs/examples/")
    ],
)
@pytest.mark.filterwarnings("ignore:.*wrong as a whole:UserWarning")
def test_code_blocks_run(page, pair, tmp_path, monkeypatch, small_pictures):
    write_mesh(tmp_path / "source.off", pair.source)
    write_mesh(tmp_path / "target.ply", pair.target)
    monkeypatch.chdir(tmp_path)
    # Readers use JAX's defaults, which are less strict than the settings of these tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"), jax.enable_x64(False):
        namespace: dict[str, object] = {}
        outcomes = []
        for block in code_blocks(page):
            for statement in ast.parse(block).body:
                exec(compile(ast.Module([statement], []), page, "exec"), namespace)
                outcomes.append(namespace.get("refinement"))
    refinements = {id(outcome): outcome for outcome in outcomes if outcome is not None}
    assert len(refinements) >= REFINEMENTS.get(page, 0)
    for refinement in refinements.values():
        assert refinement.result == RESULTS.successful
    if page == "docs/gradients.md":
        assert namespace["losses"][-1] < namespace["losses"][0]
        assert 0 < float(namespace["value"]) < 0.01
        for leaf in jax.tree.leaves(namespace["gradient"]):
            assert 0 < float(abs(leaf).max()) < float("inf")
    if page == "docs/exchange.md":
        np.testing.assert_array_equal(namespace["T"], namespace["result"].pointwise_map)
        np.testing.assert_allclose(namespace["C"], namespace["functional_map"], atol=1e-6)
        error = geodesic_error(pair.target, namespace["p2p_21"], GroundTruth.of_all_vertices(pair.truth))
        assert error.mean < 0.1
    if page == "docs/frames.md":
        assert namespace["result"] == RESULTS.successful
    if page == "docs/tutorial.md":
        assert namespace["error"].mean < 0.05 < namespace["initial"].mean
    if page == "docs/evaluation.md":
        assert namespace["perfect"].mean < namespace["nearest"].mean < 0.05
    if page == "README.md":
        assert np.isfinite(namespace["comparison"].differences()["cubic spline"].mean)
    if page == "docs/how_to/comparing_frames.md":
        assert len(namespace["comparison"].methods) == 6
    if page == "docs/how_to/many_pairs.md":
        assert set(namespace["maps"]) == set(namespace["pairs"])


def run_example(name: str, directory: Path, **numbers: int) -> dict[str, object]:
    """Run the program of an example page in a directory, with other numbers, and return its names."""
    (program,) = code_blocks(f"docs/examples/{name}.md")
    for variable, number in numbers.items():
        program, replaced = re.subn(
            rf"^{variable} = \d+$", f"{variable} = {number}", program, flags=re.MULTILINE
        )
        assert replaced == 1
    namespace: dict[str, object] = {}
    with (
        contextlib.chdir(directory),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        jax.enable_x64(False),
    ):
        exec(compile(program, name, "exec"), namespace)
    return namespace


def test_example_table_1(pair, tmp_path):
    for name in ("faust_r", "scape_r"):
        (tmp_path / "data" / name / "corres").mkdir(parents=True)
        (tmp_path / "data" / name / "off").mkdir()
        truth = {"pose1": np.arange(len(pair.true_map)), "pose2": pair.true_map}
        for shape, mesh in {"pose1": pair.source, "pose2": pair.target}.items():
            write_mesh(tmp_path / "data" / name / "off" / f"{shape}.off", mesh)
            np.savetxt(tmp_path / "data" / name / "corres" / f"{shape}.vts", truth[shape] + 1, fmt="%d")
    namespace = run_example("table_1", tmp_path, NUMBER_OF_PAIRS=1)
    table, cell = namespace["table"], namespace["cell"]
    assert list(table) == ["FAUST", "SCAPE"]
    (row,) = table["FAUST"].select(["mwp"]).rows
    failed = {**row, "target": "another", "result": "It failed.", "mean": np.nan, "seconds": np.nan}
    assert cell(SimpleNamespace(rows=[row, failed]), "mwp") == cell(table["FAUST"], "mwp") + ", 1 failed"
    assert cell(SimpleNamespace(rows=[failed]), "mwp").strip() == "failed"
    for comparison in table.values():
        assert comparison.errors("mwp").mean() < comparison.errors("initial").mean()


@pytest.mark.sampled
def test_example_table_1_on_real_shapes(shared, tmp_path):
    (tmp_path / "data").symlink_to(shared / "data")
    table = run_example("table_1", tmp_path, NUMBER_OF_PAIRS=1)["table"]
    assert list(table) == ["FAUST", "TOSCA"]
    for comparison in table.values():
        assert comparison.errors("mwp").mean() < 100 < comparison.errors("initial").mean()


def test_example_tight_or_not(tmp_path):
    namespace = run_example("tight_or_not", tmp_path, NUMBER_OF_PAIRS=1)
    assert len(namespace["comparison"].differences()) == 3


@pytest.mark.slow
def test_example_learn_a_bank(tmp_path, capsys):
    run_example("learn_a_bank", tmp_path, NUMBER_OF_STEPS=3)
    losses = [float(loss) for loss in re.findall(r"training (\S+),", capsys.readouterr().out)]
    assert len(losses) == 3 and losses[2] < losses[1] < losses[0]


def test_example_refiner_of_a_paper(tmp_path):
    comparison = run_example("refiner_of_a_paper", tmp_path, NUMBER_OF_PAIRS=1)["comparison"]
    assert comparison.errors("MWP, then Neural ZoomOut") < 1.2 * comparison.errors("MWP")


def test_example_thousand_pairs_continues(pair, tmp_path):
    (tmp_path / "meshes").mkdir()
    for name, mesh in {"a": pair.source, "b": pair.target, "c": pair.source}.items():
        write_mesh(tmp_path / "meshes" / f"{name}.off", mesh)
    assert len(run_example("thousand_pairs", tmp_path, NUMBER_OF_PAIRS=4)["missing"]) == 4
    maps = {path: path.read_bytes() for path in (tmp_path / "maps").iterdir()}
    assert len(maps) == 4
    killed = sorted(maps)[2:]
    for path in killed:
        path.unlink()
    assert len(run_example("thousand_pairs", tmp_path, NUMBER_OF_PAIRS=4)["missing"]) == len(killed)
    assert maps == {path: path.read_bytes() for path in (tmp_path / "maps").iterdir()}


def test_every_page_with_code_is_found():
    assert {"README.md", "docs/index.md", "docs/tutorial.md", "docs/how_to/cluster.md"} <= set(PAGES)
    assert sum(len(code_blocks(page)) for page in PAGES) > 30
    assert sum(len(commands(page)) for page in PAGES) > 25


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_commands_can_be_parsed(page, monkeypatch):
    def refuse(parser: argparse.ArgumentParser, message: str) -> None:
        raise ValueError(f"{page}: {parser.prog}: {message}")

    monkeypatch.setattr("jaxsmw.cli.run.Parser.error", refuse)
    for command in commands(page):
        program, *arguments = shlex.split(command)
        if program == "jaxsmw":
            make_parser().parse_args(arguments)
        elif arguments[0].startswith("scripts/"):
            script = ROOT / arguments[0]
            source = script.read_text("utf-8")
            # A script may import the options from a module that several scripts share.
            for module in re.findall(r"^from (\w+) import", source, flags=re.MULTILINE):
                if (shared := script.with_name(f"{module}.py")).exists():
                    source += shared.read_text("utf-8")
            for option in re.findall(r"--[\w-]+", command):
                assert f'"{option}"' in source, f"{page}: {arguments[0]} has no {option}"


@pytest.mark.parametrize("page", [page for page in PAGES if mentioned_commands(page)])
def test_mentioned_options_exist(page):
    (subcommands,) = (a.choices for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    for command in mentioned_commands(page):
        _, name, *arguments = shlex.split(command)
        for option in (argument.partition("=")[0] for argument in arguments if argument.startswith("--")):
            assert option in subcommands[name]._option_string_actions, (
                f"{page}: jaxsmw {name} has no {option}"
            )


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *PAGES])
def test_links_lead_to_files(page):
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        path = target.partition("#")[0]
        if path and not re.match(r"\w+:", path):
            assert ((ROOT / page).parent / path).exists(), f"{page} links to {target}, which does not exist"


def anchors(page: str) -> set[str]:
    """The anchors that GitHub and Sphinx give to the headings of a page."""
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#{1,3} (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *PAGES])
def test_links_lead_to_headings(page):
    for path, anchor in re.findall(r"\]\(([^)\s:]*\.md)?#([^)\s]+)\)", (ROOT / page).read_text("utf-8")):
        target = ((ROOT / page).parent / path).resolve() if path else ROOT / page
        assert anchor in anchors(target.relative_to(ROOT).as_posix()), (
            f"{page}: {path} has no heading #{anchor}"
        )


def test_the_research_log_has_the_tables_that_code_names():
    tables = set(
        re.findall(
            r"^#+ (Table R\d+):", (ROOT / "docs/research_log.md").read_text("utf-8"), flags=re.MULTILINE
        )
    )
    assert len(tables) > 10
    for path in (ROOT / "jaxsmw").rglob("*.py"):
        named = set(re.findall(r"Table R\d+", path.read_text("utf-8")))
        assert named <= tables, f"{path.name}: the research log has no {', '.join(sorted(named - tables))}"


def test_annotations_can_be_resolved():
    """Every name in an annotation can be looked up, except types imported only for type checkers."""
    light = ("jaxsmw.report", "jaxsmw.cli", "jaxsmw.__main__", "jaxsmw.benchmark.opponents.registry")
    resolved = 0
    for module in pkgutil.walk_packages(jaxsmw.__path__, "jaxsmw."):
        if module.name.startswith(light):
            continue
        for _, member in inspect.getmembers(importlib.import_module(module.name), inspect.isroutine):
            function = inspect.unwrap(member)
            if inspect.isfunction(function) and function.__module__ == module.name:
                get_type_hints(function)
                resolved += 1
    assert resolved > 200
