"""The script `compare_frames` stores results, refuses bad input, measures, summarises and draws figures."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import compare_frames
import jax.numpy as jnp
import numpy as np
import pytest
from frame_study import measurement, summary, variants
from frame_study.drawing import draw_forest, draw_heat_maps
from frame_study.measurement import PairName, Settings
from frame_study.variants import DEFAULT, UPDATES, Variant
from synthetic import bumpy_mesh, random_spectrum

import jaxsmw
from jaxsmw.benchmark.journal import Journal
from jaxsmw.core.banks import CubicSpline, Gabor, Meyer, tighten
from jaxsmw.core.functional_map import multiscale_kernel
from jaxsmw.core.refiner import Problem
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.core.results import RESULTS
from jaxsmw.errors import InputError
from jaxsmw.evaluation.ground_truth import read_ground_truth
from jaxsmw.evaluation.metrics import geodesic_error
from jaxsmw.report.figures import draw_functions
from jaxsmw.runtime.provenance import claimed_directory, code_digest

pytestmark = pytest.mark.study

SCRIPTS = Path(compare_frames.__file__).parent
FILTERS = 4


# Stored results


def row(name: str, value: float) -> dict[str, object]:
    return {"name": name, "value": value}


def test_journal_keeps_only_complete_rows(tmp_path):
    path = tmp_path / "table.csv"
    journal = Journal(path, ["name"])
    journal.append([row("a, with a comma", 1), row("b", 2)])
    whole = path.read_bytes()
    for torn in (b"c", b"c,3", b'"c, wi'):
        path.write_bytes(whole + torn)
        again = Journal(path, ["name"])
        assert again.rows == [{"name": "a, with a comma", "value": "1"}, {"name": "b", "value": "2"}]
        assert ["b"] in again and ["c"] not in again
        again.append([row("c", 3.5)])
        assert [r["value"] for r in Journal(path, ["name"]).rows] == ["1", "2", "3.5"]


def test_journal_survives_an_incomplete_header_and_repeated_rows(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"name,val")
    Journal(path, ["name"]).append([row("a", 1)])
    Journal(path, ["name"]).append([row("a", 2), row("b", 3)])
    journal = Journal(path, ["name"])
    assert [r["value"] for r in journal.rows] == ["1", "3"]
    journal.sort([["b"], ["a"]])
    with path.open() as file:
        assert list(csv.reader(file)) == [["name", "value"], ["b", "3"], ["a", "1"]]


def test_results_of_different_origin_are_never_mixed(tmp_path):
    origin = {"settings": {"seed": 0, "frames": ("Meyer",)}, "versions": {"jax": "1.0"}}
    for _ in range(2):
        claim(tmp_path, origin)
    for group, name, value in (
        ("settings", "seed", 1),
        ("settings", "new", 1),
        ("settings", "frames", ("Meyer", "heat")),
        ("versions", "jax", "1.1"),
    ):
        with pytest.raises(InputError, match=name):
            claim(tmp_path, {**origin, group: {**origin[group], name: value}})
    with (
        claimed_directory(tmp_path, origin),
        pytest.raises(InputError, match="another process is adding results"),
    ):
        claim(tmp_path, origin)
    (tmp_path / "provenance.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        claim(tmp_path, origin)
    (tmp_path / "provenance.json").unlink()
    (tmp_path / "results.csv").touch()
    with pytest.raises(InputError, match="unknown origin"):
        claim(tmp_path, origin)


def claim(directory, origin):
    with claimed_directory(directory, origin):
        pass


def test_code_digest_depends_on_code_but_not_on_comments_or_layout(tmp_path):
    path = tmp_path / "code.py"

    def digest(text: str) -> str:
        path.write_text(text)
        return code_digest([path])

    plain = digest("def f(x):\n    return x + 1\n")
    assert digest('"""Doc."""\n\n# why\ndef f(x):\n    """More."""\n    return (x + 1)  # so\n') == plain
    assert digest("def f(x):\n    return x + 2\n") != plain


STUDY = """
import os, sys, time
from pathlib import Path
sys.path[:0] = [{scripts!r}, {here!r}]
import compare_frames, slow
from frame_study.measurement import PairName, Settings
from frame_study.variants import DEFAULT

if __name__ == "__main__":
    compare_frames.measure = slow.measure
    settings = Settings(parameter_pairs=1, parameter_eigenvectors=(5,), parameter_filters=(2,))
    pairs = [PairName("faust_r", "a", str(i)) for i in range(6)]
    variants = [DEFAULT, DEFAULT._replace(update="regularized")]
    journals = compare_frames.Journals(Path({here!r}), pairs, settings, variants)
    compare_frames.run(Path(), journals, workers=2)
    journals.sort()
"""
SLOW = """
import os, time
from pathlib import Path

def measure(data, task, settings):
    log = os.open({log!r}, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(log, f"{{os.getpid()}} {{task.name.target}} {{len(task.variants)}}\\n".encode())
    time.sleep(0.3)
    name = task.name._asdict()
    return (
        [name | variant._asdict() | {{"error": 1}} for variant in task.variants],
        [name | {{"eigenvectors": k, "filters": f}} for k, f in task.parameters],
        [name | {{"frame": frame, "scale": scale}} for frame, scale in task.wavelets],
    )
"""


@pytest.mark.sampled
def test_only_missing_measurements_run_after_a_kill(tmp_path):
    log, results = tmp_path / "log", tmp_path / "results.csv"
    (tmp_path / "study.py").write_text(STUDY.format(scripts=str(SCRIPTS), here=str(tmp_path)))
    (tmp_path / "slow.py").write_text(SLOW.format(log=str(log)))
    command = [sys.executable, str(tmp_path / "study.py")]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (results.exists() and results.read_bytes().count(b"\n") >= 3):
        assert first.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.wait()
    begun = [line.split() for line in log.read_text().splitlines()]
    # After the kill, the worker processes must also end.
    while any(is_alive(int(pid)) for pid, *_ in begun):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    # Remove the last row of the file, and truncate the second-to-last row.
    lines = results.read_bytes().splitlines(keepends=True)
    kept = [*lines[:-2], lines[-2][:-4]]
    results.write_bytes(b"".join(kept))
    whole = {
        tuple(r[name] for name in ("target", "update")) for r in Journal(results, ["target", "update"]).rows
    }
    before = len(begun)

    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    with results.open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["target"], r["update"]) for r in rows] == [
        (str(i), update) for i in range(6) for update in ("filtering", "regularized")
    ]
    again = [line.split() for line in log.read_text().splitlines()][before:]
    missing = {target: 2 - sum(t == target for t, _ in whole) for target in map(str, range(6))}
    assert {target: int(count) for _, target, count in again} == {t: n for t, n in missing.items() if n}
    assert len(Journal(tmp_path / "invariance.csv", ["target", "frame", "scale"]).rows) == 6 * 2 * 6
    assert len(Journal(tmp_path / "parameters.csv", ["target"]).rows) == 1


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A zombie process has ended, although its parent has not waited for it.
    status = Path(f"/proc/{pid}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


def test_pairs_are_evenly_spread(tmp_path):
    for data_set in ("faust_r", "tosca_r"):
        (tmp_path / data_set).mkdir()
        lines = [f"{data_set}{i}\tother{i}" for i in range(9)]
        (tmp_path / data_set / "test_pairs.txt").write_text("\n".join(lines) + "\n")
    chosen = compare_frames.select_pairs(tmp_path, 3)
    assert [pair.source for pair in chosen] == [
        "faust_r0",
        "faust_r4",
        "faust_r8",
        "tosca_r0",
        "tosca_r4",
        "tosca_r8",
    ]
    assert len(set(compare_frames.select_pairs(tmp_path, 100))) == 18
    with pytest.raises(InputError, match="test_pairs"):
        compare_frames.select_pairs(tmp_path / "faust_r", 3)


# Compared variants


@pytest.mark.parametrize(
    ("convention", "update"),
    [
        ("pullback", "least squares (area)"),
        ("pullback", "regularized"),
        ("pushforward", "filtering"),
        ("pushforward", "least squares (Frobenius)"),
    ],
)
def test_padding_and_tabulated_filters_have_no_effect(convention, update):
    x, y = (random_spectrum(n, 10, seed=n) for n in (150, 170))
    start = np.random.default_rng(0).integers(0, 170, 150)
    bank = CubicSpline(FILTERS)
    padded_x, padded_y = measurement.pad(x), measurement.pad(y)
    assert len(padded_x.mask) == len(padded_y.mask) > 170
    variant = Variant("cubic spline", update, convention)
    method = variants.refiner(variant, bank, padded_x, padded_y, number_of_filters=FILTERS + 2)
    refined = jaxsmw.refine(padded_x, padded_y, measurement.pad_map(start, padded_x), refiner=method)
    expected = jaxsmw.refine(
        x, y, jnp.asarray(start), refiner=WaveletPreservation(bank, UPDATES[update], convention=convention)
    )
    assert refined.result == RESULTS.successful and expected.result == RESULTS.successful
    np.testing.assert_allclose(refined.functional_map, expected.functional_map, atol=1e-9)
    np.testing.assert_array_equal(refined.pointwise_map[:150], expected.pointwise_map)
    np.testing.assert_array_equal(start, measurement.pad_map(start, padded_x)[:150])


def test_band_mask_is_as_wide_as_the_kernel_but_belongs_to_no_frame():
    x, y = (random_spectrum(300, 60, seed=seed) for seed in (1, 2))
    bank = Meyer(6)
    for convention, (out, into) in {"pullback": (x, y), "pushforward": (y, x)}.items():
        variant = Variant("Meyer", "band mask", convention)
        mask = np.asarray(variants.refiner(variant, bank, x, y, number_of_filters=6).solution.mask)
        kernel = multiscale_kernel(variants.tabulate(bank, out, 6), variants.tabulate(bank, into, 6))
        assert mask.min() >= 0 and mask.max() <= 1
        np.testing.assert_allclose(mask.sum(), kernel.sum(), rtol=1e-9)
    assert variants.least_kernel_eigenvalue(variant, bank, x, number_of_filters=6) < -0.01
    meyer = DEFAULT._replace(convention="pushforward")
    assert variants.least_kernel_eigenvalue(meyer, bank, x, number_of_filters=6) > -1e-12

    octaves = np.linspace(0, 5, 51)
    mask = variants.band_mask(octaves, octaves, 0.8)
    np.testing.assert_array_equal(mask, mask.T)
    np.testing.assert_allclose(mask[0, [0, 4, 8, 12, 13]], [1, 1, 0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(variants.octaves(np.array([0, 1, 2, 4, 32.0]), 5), [0, 0, 0, 1, 4])


def test_projection_gives_the_nearest_orthogonal_matrix():
    x, y = (random_spectrum(n, 10, seed=n) for n in (150, 170))
    start = jnp.arange(150)
    found = {}
    for update in ("filtering", "projected"):
        method = variants.refiner(DEFAULT._replace(update=update), Meyer(4), x, y, number_of_filters=4)
        problem = method.prepare(Problem(x, y))
        found[update] = np.asarray(method.update(problem, start, None)[0].functional_map)
    np.testing.assert_allclose(found["projected"] @ found["projected"].T, np.eye(10), atol=1e-12)
    nearest = np.linalg.norm(found["projected"] - found["filtering"])
    generator = np.random.default_rng(0)
    for _ in range(20):
        other, _ = np.linalg.qr(found["projected"] + 0.05 * generator.normal(size=(10, 10)))
        other *= np.sign(np.sum(other * found["projected"], axis=0))
        assert np.linalg.norm(other - found["filtering"]) > nearest


def test_only_provably_equal_variants_are_not_measured():
    every = variants.variants(variants.frames(FILTERS))
    banks = variants.frames(FILTERS)
    twins = variants.twins(every, banks)
    frames = {variant.frame for variant in twins}
    assert {
        "Meyer",
        "itersine",
        "Gabor, tightened",
        "no filter",
        "itersine, warped by the spectrum",
    } <= frames
    assert not frames & {"cubic spline", "Mexican hat", "heat", "Gabor", "low-pass (1 filter)"}
    assert all(v.convention == "pushforward" and v.update == "least squares (area)" for v in twins)
    assert set(twins.values()) <= set(every) and len(every) == len(set(every)) > 150

    x, y = (random_spectrum(n, 10, seed=n) for n in (150, 170))
    for frame in ("Meyer", "Gabor, tightened"):
        one, other = (
            variants.refiner(variant, banks[frame], x, y, number_of_filters=FILTERS)
            for variant in (Variant(frame, u, "pushforward") for u in ("filtering", "least squares (area)"))
        )
        prepared = [m.prepare(Problem(x, y)) for m in (one, other)]
        maps = [
            m.update(p, jnp.arange(150), None)[0].functional_map
            for m, p in zip((one, other), prepared, strict=True)
        ]
        np.testing.assert_allclose(*maps, atol=1e-9)


def test_tightened_gabor_is_parseval_and_gabor_is_not():
    assert variants.is_parseval(tighten(Gabor(FILTERS))) and not variants.is_parseval(Gabor(FILTERS))


@pytest.mark.sampled
def test_measurements_of_a_real_pair_are_consistent(shared):
    name = PairName("faust_r", "tr_reg_000", "tr_reg_004")
    settings = Settings(
        number_of_eigenvectors=30,
        iterations=2,
        evaluated_points=50,
        parameter_iterations=2,
        wavelet_centers=20,
    )
    pair = measurement.load_pair(shared / "data", name, settings)
    corres = [shared / "data" / "faust_r" / "corres" / f"{shape}.vts" for shape in name[1:]]
    truth = read_ground_truth(corres, pair.mesh_x, pair.mesh_y)
    pointwise_map = np.asarray(pair.start)[: len(pair.mesh_x.vertices)]
    expected = geodesic_error(
        pair.mesh_y, pointwise_map, truth, number_of_samples=50, seed=settings.seed
    ).mean
    assert pair.error(np.asarray(pair.start)) == pytest.approx(expected, rel=1e-12)

    found = measurement.measure_variants(pair, name, [DEFAULT], settings)[0]
    assert found["result"] == "successful" and found["error_0"] == f"{expected:.7f}"
    assert float(found["error_2"]) < 0.3 * expected
    assert 0 < float(found["moved_2"]) < float(found["changed_2"]) < 1
    assert 0 < float(found["energy"]) < float(found["energy_of_zero"]) == pytest.approx(30, rel=1e-5)
    parameters = measurement.measure_parameters(pair, name, [(30, 6), (20, 6)], settings)
    assert float(parameters[0]["error_2"]) == pytest.approx(float(found["error_2"]), rel=0.02)
    assert parameters[1]["error_2"] != parameters[0]["error_2"]

    wavelets = measurement.measure_invariance(pair, name, [("Meyer", 0), ("Meyer", 5)], settings)
    coarse, fine = (float(w["relative_difference"]) for w in wavelets)
    assert 0 < coarse < 0.2 < fine < 1.41
    swapped = replace(pair, spectra=pair.spectra[:1] * 2, targets=pair.sources)
    same = measurement.measure_invariance(swapped, name, [("Meyer", 5)], settings)[0]
    assert float(same["relative_difference"]) == 0 and float(same["correlation"]) == pytest.approx(1)


# Summaries


def test_interval_is_a_confidence_interval_of_the_mean():
    sample = np.random.default_rng(3).normal(2, 1, 400)
    mean, low, high = summary.mean_interval(sample, seed=0)
    half = 1.96 * sample.std() / 20
    assert mean == pytest.approx(sample.mean())
    assert low == pytest.approx(mean - half, abs=0.1 * half) and high == pytest.approx(
        mean + half, abs=0.1 * half
    )
    assert summary.mean_interval(sample, seed=0) == (mean, low, high)
    assert summary.mean_interval(sample, seed=1) != (mean, low, high)
    assert summary.mean_interval(np.full(5, 0.25), seed=0) == (0.25, 0.25, 0.25)
    assert np.isnan(summary.mean_interval(np.full(1, 0.25), seed=0)).tolist() == [False, True, True]
    mean, low, high = summary.mean_interval(np.array([1.0, 2.0]), seed=0)
    assert mean == 1.5 and np.isnan(low) and np.isnan(high)
    assert np.isnan(summary.mean_interval(np.array([]), seed=0)).all()


def test_comparison_is_paired_and_counts_failures():
    generator = np.random.default_rng(0)
    reference = generator.uniform(10, 1000, 40)  # errors differ far more between pairs than between variants
    errors = reference - 1 + generator.normal(0, 0.1, 40)
    errors[:4] = reference[:4] + 2
    errors[-6:] = np.nan
    found = summary.compare(errors, reference, seed=0)
    assert found.failures == 6
    assert found.better == 30 / 40
    assert found.difference.mean == pytest.approx((4 * 2 - 30) / 34, abs=0.1)
    assert -1.1 < found.difference.low < found.difference.mean < found.difference.high < 0
    assert found.mean == pytest.approx(errors[:-6].mean()) and found.median == np.median(errors[:-6])
    nothing = summary.compare(np.full(3, np.nan), np.ones(3), seed=0)
    assert nothing.failures == 3 and nothing.better == 0 and np.isnan(nothing.mean)


@pytest.fixture(scope="module")
def made_up() -> summary.Study:
    """A study with invented numbers.

    On every second pair, the error of all variants except the default is ten times the error of the default.
    Low-pass variants fail on all pairs unless their update is filtering.
    """
    settings = replace(compare_frames.QUICK, pairs=4, iterations=3)
    every = variants.variants(settings.frames)
    twins = variants.twins(every, variants.frames(6))
    pairs = [PairName(d, "a", str(i)) for d in measurement.DATA_SETS for i in range(4)]
    rows, times = [], []
    for variant in every:
        if variant in twins:
            continue
        fails = variant.frame == "low-pass (1 filter)" and variant.update != "filtering"
        for i, pair in enumerate(pairs):
            error = "nan" if fails else 0.01 if variant == DEFAULT or i % 2 else 0.1
            rows.append(
                {**pair._asdict(), **variant._asdict(), "result": "Nothing." if fails else "successful"}
                | {
                    "error_0": 0.5,
                    "error_3": error,
                    "energy": 20,
                    "energy_of_zero": 100,
                    "condition_number": 7,
                }
                | {f"moved_{t}": "nan" if fails else 0.2 / 10 ** max(t - i % 2, 0) for t in (1, 2, 3)}
                | {"least_kernel_eigenvalue": -0.25 if variant.update == "band mask" else -1e-8}
            )
        times.append({**pairs[0]._asdict(), **variant._asdict(), "milliseconds": "2.5"})
    times.append({**pairs[0]._asdict(), **measurement.SEARCH._asdict(), "milliseconds": "80"})
    return summary.Study(rows, times, pairs, every, twins, settings)


def test_study_summarises_known_numbers(made_up):
    spline = Variant("cubic spline", "filtering", "pullback")
    found = made_up.comparisons[spline, "both"]
    assert found.mean == pytest.approx(55) and found.difference.mean == pytest.approx(45)
    assert found.better == 0 and found.failures == 0
    # The map settles in iteration 1 on even pairs, and in iteration 2 on odd pairs.
    assert made_up.median_settling(spline, "both") == 1.5
    assert made_up.relative_energy(spline, "faust_r") == pytest.approx(0.2)
    twin = Variant("Meyer", "least squares (area)", "pushforward")
    assert made_up.comparisons[twin, "both"] == made_up.comparisons[twin._replace(update="filtering"), "both"]
    assert np.isnan(made_up.interval(None, "both")).all()


def test_summary_shows_all_results(made_up):
    scales = [
        {"data_set": d, "frame": f, "scale": str(s), "relative_difference": f"0.{s}1", "correlation": "0.5"}
        for d in measurement.DATA_SETS
        for f in measurement.INVARIANCE_FRAMES
        for s in range(6)
    ]
    text = summary.write_summary(made_up, scales)
    interval = r"\+45\.0 \[\+\d+\.\d, \+\d+\.\d\]"
    row = rf"\| cubic spline \| filtering \| 55\.0 \| 55\.0 \| {interval} \| 0% \| 0\.2 \| 1\.5 \| 2\.5 \| 7 \|  \|"
    assert re.search(row, text)
    assert "| Meyer | = least squares (area) |" in text
    assert "| low-pass (1 filter) | 55.0 (+45.0" in text and "| failed | failed | failed |" in text
    assert "| low-pass (1 filter) | least squares (area) | pullback | 8 of 8 | Nothing. |" in text
    assert "| −0.25 |" in text
    assert "| tosca_r | Meyer | relative difference | 0.010 | 0.110 | 0.210 | 0.310 | 0.410 | 0.510 |" in text
    cells = None
    for line in text.splitlines():  # every row of a table has as many cells as its header
        cells = (cells or line.count(" | ")) if line.startswith("|") else None
        assert cells is None or line.count(" | ") == cells


# Figures


def test_forest_plot_shows_every_estimate():
    intervals = np.array([[1.0, 0.5, 2.0], [np.nan] * 3, [-20, -30, -10]])
    figure = draw_forest({"one": {"a": intervals, "b": intervals}}, rows=["p", "q", "r"], xlabel="difference")
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["p", "q", "r"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]
    drawn = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 3]
    np.testing.assert_array_equal(drawn, [intervals[:, 0]] * 2)
    low, high = axes.get_xlim()
    assert low < -30 and high > 2
    with pytest.raises(InputError, match=r"\(2, 3\)"):
        draw_forest({"one": {"a": intervals}}, rows=["p", "q"], xlabel="difference")


def test_heat_maps_show_their_numbers():
    tables = {"one": np.array([[1.0, 20.0], [3.0, 400.0]]), "two": np.full((2, 2), 5.0)}
    figure = draw_heat_maps(tables, rows=("k", [20, 40]), columns=("filters", [2, 3]), label="error")
    written = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert written == ["1.0", "20.0", "3.0", "400", *["5.0"] * 4]
    with pytest.raises(InputError, match="two"):
        draw_heat_maps(
            {**tables, "two": -np.ones((2, 2))}, rows=("k", [20, 40]), columns=("f", [2, 3]), label="e"
        )


def test_functions_on_bodies_are_red_above_and_blue_below_zero():
    mesh = bumpy_mesh(3)
    up = np.sign(mesh.vertices[:, 2])
    figure = draw_functions([mesh, mesh], [np.stack([up, -up])] * 2, titles=["f", "g"], marked=[0, 1], up="z")
    pictures = [np.asarray(axes.images[0].get_array(), dtype=float) for axes in figure.axes]
    assert len(pictures) == 4
    for picture, sign in zip(pictures, (1, 1, -1, -1), strict=True):
        seen = picture[..., 3] == 255
        redness = np.where(seen, picture[..., 0] - picture[..., 2], 0)
        half = len(redness) // 2
        assert sign * redness[: half - 20].sum() > 0 > sign * redness[half + 20 :].sum()
    with pytest.raises(InputError, match="shape"):
        draw_functions([mesh], [up[None]], titles=["f", "g"], marked=[0])
