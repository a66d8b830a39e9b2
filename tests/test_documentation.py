"""The code blocks of README and docs, run as a reader would, from top to bottom."""

import ast
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxsmw import RESULTS, GroundTruth, creature_pair, geodesic_error, write_mesh

ROOT = Path(__file__).parents[1]


def code_blocks(path: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(
    ("page", "least"),
    [("README.md", 2), ("docs/frames.md", 2), ("docs/gradients.md", 1), ("docs/exchange.md", 1)],
)
def test_code_blocks_run(page, least, tmp_path, monkeypatch):
    pair = creature_pair(vertices=700)
    write_mesh(tmp_path / "source.off", pair.source)
    write_mesh(tmp_path / "target.ply", pair.target)
    monkeypatch.chdir(tmp_path)
    # Readers use JAX as it comes, without the strictness of these tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"), jax.enable_x64(False):
        namespace: dict[str, object] = {}
        blocks = code_blocks(ROOT / page)
        assert len(blocks) >= 2
        outcomes = []
        for block in blocks:
            for statement in ast.parse(block).body:
                exec(compile(ast.Module([statement], []), page, "exec"), namespace)
                outcomes.append(namespace.get("refinement"))
    refinements = {id(outcome): outcome for outcome in outcomes if outcome is not None}
    assert len(refinements) >= least
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
