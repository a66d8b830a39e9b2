"""Helpers that the tests of the command line share."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from synthetic import bumpy_mesh

from jaxsmw.cli.run import run_command
from jaxsmw.geometry.mesh import make_mesh
from jaxsmw.io.meshes import write_mesh

COMMANDS = (
    "demo",
    "match",
    "transfer",
    "collection",
    "complete",
    "evaluate",
    "benchmark",
    "spectrum",
    "render",
)
# Options that make the paper's method fast. The mirror test would compile further programs.
SMALL = ("--eigenvectors", "20", "--filters", "4", "--mirror", "no")


class Outcome(NamedTuple):
    """The exit code of a command, its standard output and its standard error."""

    code: int
    output: str
    errors: str


def runner(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Return a function that runs the command line in this process."""

    def run(*arguments: object) -> Outcome:
        code = run_command([str(argument) for argument in arguments])
        return Outcome(code, *capsys.readouterr())

    return run


def assert_refused(outcome: Outcome, *, naming: str) -> None:
    """Check that the exit code is 2, and that the error message is one sentence that contains `naming`."""
    assert outcome.code == 2, outcome.errors
    assert outcome.output == ""
    assert outcome.errors.count("\n") == 1 and len(outcome.errors) > 40
    assert naming in outcome.errors


def write_pair(directory: Path) -> Path:
    """Write a body, a renumbered noisy copy, and their ground truth in several formats to a directory."""
    mesh = bumpy_mesh(3)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    truth = np.argsort(order)
    write_mesh(directory / "x.off", mesh)
    noisy = mesh.vertices[order] + 0.01 * np.random.default_rng(1).normal(size=mesh.vertices.shape)
    write_mesh(directory / "y.ply", make_mesh(noisy * 3, truth[mesh.faces]))
    np.savetxt(directory / "truth.txt", truth, fmt="%d")
    np.savetxt(directory / "truth1.txt", truth + 1, fmt="%d")
    np.savetxt(directory / "x.vts", np.arange(len(truth)) + 1, fmt="%d")
    np.savetxt(directory / "y.vts", truth + 1, fmt="%d")
    np.savetxt(
        directory / "landmarks.txt", np.stack([np.arange(5) * 50, truth[np.arange(5) * 50]], 1), fmt="%d"
    )
    return directory
