"""The command line refuses bad files, bad arguments, and outputs that cannot be written."""

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import SMALL, assert_refused, write_pair
from messages import assert_names
from synthetic import bumpy_mesh

from jaxsmw.errors import InputError
from jaxsmw.io.meshes import write_mesh
from jaxsmw.runtime.files import atomic_write, check_directory, check_writable, make_directory


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    return write_pair(tmp_path_factory.mktemp("pair"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*the map is wrong as a whole:UserWarning")
def test_a_tiny_mesh_is_refused(run, tmp_path):
    (tmp_path / "tetrahedron.off").write_text(OFF.format(4, 4, TRIANGLES, FACES))
    call = ["match", *[tmp_path / "tetrahedron.off"] * 2, "--output", tmp_path / "map.txt", "--quiet"]
    assert_refused(run(*call), naming="the initial map 'wks'")
    assert_refused(run(*call, "--eigenvectors", "100"), naming="choose a number from 1 to 3")
    assert_refused(
        run(*call, "--eigenvectors", "1", "--init", "hks"),
        naming="the largest of the 1 eigenvalues is zero",
    )
    assert_refused(run(*call, "--eigenvectors", "3"), naming="the initial map 'wks'")
    assert run(*call, "--eigenvectors", "3", "--init", "hks").code == 0


def test_a_missing_file_is_named_before_libraries_are_imported(tmp_path):
    program = "import sys; from jaxsmw.cli.run import run_command; code = run_command(sys.argv[1:]);"
    program += "sys.exit(100 if 'jax' in sys.modules else code)"
    mesh, missing = tmp_path / "x.off", tmp_path / "missing.off"
    write_mesh(mesh, bumpy_mesh(1))
    for words in (
        ["match", mesh, missing, "--output", tmp_path / "map.txt"],
        ["transfer", mesh, missing, "--registered", tmp_path / "r.ply"],
        ["evaluate", mesh, mesh, missing, "--ground-truth", mesh],
        ["render", missing, "--output", tmp_path / "x.png"],
        ["spectrum", missing],
    ):
        ended = subprocess.run(
            [sys.executable, "-c", program, *map(str, words)], capture_output=True, text=True
        )
        assert ended.returncode == 2, ended.stderr
        assert ended.stderr == f"jaxsmw: {missing}: does not exist: check the path.\n"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems ignore this limit")
def test_a_small_limit_of_address_space_is_refused_before_libraries_are_loaded(pair):
    program = "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (3 * 10**8, 3 * 10**8));"
    program += "from jaxsmw.cli import main; main()"
    words = ["match", pair / "x.off", pair / "y.ply", "--output", pair / "limited.txt"]
    ended = subprocess.run(
        [sys.executable, "-c", program, *words], capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 2 and not (pair / "limited.txt").exists()
    assert ended.stderr.count("\n") == 1
    assert_names(ended.stderr, "address space", "0.30 GB", "2 GB", "raise the limit (ulimit -v)")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not remove the working directory")
def test_a_removed_working_directory_is_refused(run, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert_refused(run("spectrum", "../x.off"), naming="the working directory cannot be used (No such file")


@pytest.mark.parametrize("scale", ["1e300", "1e-300"])
def test_extreme_scales_are_refused(run, pair, tmp_path, scale):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", "--partial", "--quiet"]
    assert_refused(run(*call, "--scale", scale), naming="give a number from 1e-100 to 1e100")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such names")
def test_control_characters_of_names_are_escaped(run, tmp_path):
    """The names contain a line break, a code that clears a terminal, and a byte that is not UTF-8."""
    hostile = tmp_path / "a\nb\x1b[2J\udcff é.off"
    assert_refused(run("spectrum", hostile), naming=r"a\nb\x1b[2J\udcff é.off: does not exist")
    write_mesh(hostile, bumpy_mesh(2))
    out = tmp_path / "\n.npz"
    ended = run("spectrum", hostile, "--eigenvectors", "3", "--output", out)
    assert ended.code == 0 and out.exists()
    assert not any(c in ended.output + ended.errors for c in "\x1b\udcff")


def test_a_missing_matplotlib_is_reported_before_the_work(run, pair, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    meshes, truth = [pair / "x.off", pair / "y.ply"], pair / "truth.txt"
    for arguments in (
        ["match", *meshes, "--output", tmp_path / "m", "--report", tmp_path / "r"],
        ["transfer", *meshes, "--report", tmp_path / "r"],
        ["demo", "--output", tmp_path / "demo"],
        ["spectrum", pair / "x.off", "--figure", tmp_path / "s.png"],
        ["evaluate", *meshes, truth, "--ground-truth", truth, "--page", tmp_path / "p.html"],
    ):
        assert_refused(run(*arguments, "--quiet"), naming="pip install 'jaxsmw[report]'")
    assert list(tmp_path.iterdir()) == []


def test_benchmarks_without_their_libraries_are_refused(run, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "jaxsmw.benchmark.benchmark", raising=False)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    outcome = run("benchmark", tmp_path, "--output", tmp_path / "o")
    assert_refused(outcome, naming="pip install 'jaxsmw[benchmark]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("points.txt", "choose a name that ends in .baryc_gt"),
        ("missing/points.baryc_gt", "missing"),
        ("truth.baryc_gt", "is an input"),
        ("errors.baryc_gt", "two outputs have this name"),
        ("start.baryc_gt", "is an input"),
    ],
)
def test_surface_points_that_cannot_be_written_are_refused(run, pair, tmp_path, name, fault):
    (tmp_path / "truth.baryc_gt").write_text("1 1 0 0\n" * 642)
    (tmp_path / "start.baryc_gt").write_text("0\n" * 642)
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL, "--quiet"]
    call += ["--init", f"map:{tmp_path / 'start.baryc_gt'}", "--ground-truth", tmp_path / "truth.baryc_gt"]
    call += ["--expected-error", tmp_path / "errors.baryc_gt"]
    assert_refused(run(*call, "--surface-points", tmp_path / name), naming=fault)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["start.baryc_gt", "truth.baryc_gt"]
    assert (tmp_path / "start.baryc_gt").read_text() == "0\n" * 642


def test_an_impossible_one_to_one_map_is_refused_before_the_work(run, pair, tmp_path):
    write_mesh(tmp_path / "small.off", bumpy_mesh(2))
    call = ["match", pair / "x.off", tmp_path / "small.off", "--output", tmp_path / "map.txt", *SMALL]
    outcome = run(*call, "--quiet", "--one-to-one", tmp_path / "one.txt")
    assert_refused(outcome, naming="642 vertices of the source cannot be matched one to one to the 162")
    assert not (tmp_path / "map.txt").exists()


def test_outputs_with_the_same_name_are_refused(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "map.txt", *SMALL]
    assert_refused(run(*call, "--one-to-one", tmp_path / "map.txt"), naming="two outputs have this name")
    search = [*call[:5], "--alternatives", "2"]
    clash = run(*search, "--one-to-one", tmp_path / "map_alternative_2.txt")
    assert_refused(clash, naming="map_alternative_2.txt: two outputs have this name")
    call += ["--expected-error", tmp_path / "source.obj"]
    assert_refused(run(*call, "--texture", tmp_path), naming="two outputs have this name")
    (tmp_path / "target.obj").write_text("v 0 0 0\n")
    call = ["match", pair / "x.off", tmp_path / "target.obj", "--output", tmp_path / "map.txt", *SMALL]
    assert_refused(run(*call, "--texture", tmp_path), naming="is an input")


OFF = "OFF\n{} {} 0\n{}\n{}\n"
TRIANGLES = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
FACES = "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
HOSTILE_MESHES = {
    "empty.off": b"",
    "blank.off": b"\n\n\n",
    "junk.off": bytes(range(256)) * 20,
    "junk.ply": bytes(range(256)) * 20,
    "junk.stl": bytes(range(256)) * 20,
    "junk.obj": bytes(range(256)) * 20,
    "header_only.off": b"OFF\n",
    "promises_more.off": OFF.format(400, 4, TRIANGLES, FACES).encode(),
    "promises_fewer.off": OFF.format(2, 1, TRIANGLES, FACES).encode(),
    "promises_a_trillion.off": OFF.format(10**12, 10**12, TRIANGLES, FACES).encode(),
    "negative_counts.off": OFF.format(-4, -4, TRIANGLES, FACES).encode(),
    "words.off": OFF.format(4, 4, TRIANGLES.replace("1", "one"), FACES).encode(),
    "truncated.off": OFF.format(4, 4, TRIANGLES, FACES).encode()[:40],
    "nan.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "nan 0 0"), FACES).encode(),
    "infinite.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "inf 0 0"), FACES).encode(),
    "overflow.off": OFF.format(4, 4, TRIANGLES.replace("1 0 0", "1e999 0 0"), FACES).encode(),
    "out_of_range.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 2\n", "3 4\n")).encode(),
    "negative_index.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 2\n", "3 -2\n")).encode(),
    "huge_index.off": OFF.format(
        4, 4, TRIANGLES, FACES.replace("3 2\n", "3 99999999999999999999\n")
    ).encode(),
    "two_corners.off": OFF.format(4, 4, TRIANGLES, FACES.replace("3 0 3 2", "2 0 3")).encode(),
    "no_faces.off": OFF.format(4, 0, TRIANGLES, "").encode(),
    "no_area.off": OFF.format(4, 4, TRIANGLES.replace("1", "0"), FACES).encode(),
    "no_end.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
    "short.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n1234",
    "no_z.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
    "wrong_count.stl": b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 50,
    "points.obj": b"v 0 0 0\nv 1 0 0\n",
    "zero.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
    "mesh.xyz": b"0 0 0\n",
    "mesh": b"OFF\n",
}


@pytest.mark.parametrize("name", HOSTILE_MESHES)
def test_hostile_mesh_files_are_refused(run, pair, tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE_MESHES[name])
    for meshes in ([tmp_path / name, pair / "y.ply"], [pair / "x.off", tmp_path / name]):
        outcome = run("match", *meshes, "--output", tmp_path / "map.txt", "--quiet", *SMALL)
        assert_refused(outcome, naming=name)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]


HOSTILE_MAPS = {
    "empty": "",
    "too short": "0\n" * 641,
    "too long": "0\n" * 643,
    "out of range": "0\n" * 641 + "642\n",
    "negative": "0\n" * 641 + "-1\n",
    "huge": "0\n" * 641 + "9" * 40 + "\n",
    "fractions": "0.5\n" * 642,
    "words": "zero\n" * 642,
    "nan": "nan\n" * 642,
    "two columns": "0 0\n" * 642,
    "binary": "\0\1\2" * 300,
    "one-based": "\n".join(str(i) for i in range(1, 643)),
}


@pytest.mark.parametrize("use", ["init", "truth", "evaluate", "render"])
@pytest.mark.parametrize("name", HOSTILE_MAPS)
def test_hostile_map_files_are_refused(run, pair, tmp_path, name, use):
    if (name, use) == ("two columns", "truth"):
        pytest.skip("two columns are a legal form of ground truth")
    path = tmp_path / "hostile.txt"
    path.write_text(HOSTILE_MAPS[name])
    meshes, output = (
        (pair / "x.off", pair / "y.ply"),
        tmp_path / ("out.png" if use in ("evaluate", "render") else "out"),
    )
    truth = ["--ground-truth", pair / "truth.txt"]
    outcome = {
        "init": lambda: run("match", *meshes, "--init", f"map:{path}", "--output", output, "--quiet"),
        "truth": lambda: run("match", *meshes, "--ground-truth", path, "--output", output, "--quiet"),
        "evaluate": lambda: run("evaluate", *meshes, path, *truth, "--figure", output, "--quiet"),
        "render": lambda: run("render", *meshes, path, "--output", output, "--quiet"),
    }[use]()
    assert_refused(outcome, naming="hostile.txt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["hostile.txt"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("match {x} {y}", "--output"),
        ("match {x} {y} --output {t}/no/such/map.txt", "no/such"),
        (
            "match {x} {y} --output {t}/m --evaluation-samples 9",
            "--evaluation-samples: has no effect without --ground-truth",
        ),
        (
            "match {x} {y} --output {t}/m --index-base 1",
            "--index-base: has no effect without --ground-truth or a file of --init",
        ),
        ("match {x} {y} --output {t}/m --up z", "--up: has no effect without --report"),
        (
            "match {x} {y} --output {t}/m --geodesics exact",
            "--geodesics: has no effect without --ground-truth",
        ),
        ("match {x} {y} --output {t}/m --seed 3", "--seed: has no effect without --evaluation-samples"),
        ("match {x} {y} --output {t}/m.vts", "m.vts: maps are written"),
        ("match {x} {y} --output {t}/m --one-to-one {t}/o.baryc_gt", "o.baryc_gt: maps are written"),
        ("match {x} {y} --output {t}/o.png", "not as .png: choose a name with another suffix, such as .txt"),
        ("match {x} {y} --output {t}/o.HTML", "o.HTML: maps are written as text"),
        ("match {x} {y} --output {t}/m --one-to-one {t}/o.ply", "o.ply: maps are written as text"),
        (
            "evaluate {x} {y} {t}/m --ground-truth {t}/m --seed 3",
            "--seed: has no effect without --evaluation-samples",
        ),
        ("render {x} --output {t}/m.png --index-base 1", "--index-base: has no effect without a map"),
        ("match {x} {y} --output {t}", "is not a file"),
        ("match {x} {y} --output /proc/map.txt", "/proc/map.txt"),
        ("match {x} {t}/missing.off --output {t}/m", "missing.off"),
        ("match {x} {t} --output {t}/m", "not a regular file"),
        ("match {x} {y} --output {t}/m --eigenvectors 642", "641"),
        ("match {x} {y} --output {t}/m --eigenvectors 99999999999999999999", "99999999999999999999"),
        ("match {x} {y} --output {t}/m --eigenvectors 0", "at least 1"),
        ("match {x} {y} --output {t}/m --eigenvectors many", "is not a whole number"),
        ("match {x} {y} --output {t}/m --filters 1", "at least 2"),
        ("match {x} {y} --output {t}/m --bank haar", "haar"),
        ("match {x} {y} --output {t}/m --bank held --filters 3", "--filters"),
        ("match {x} {y} --output {t}/m --bank half-cosine --filters 2", "at least 3 filters"),
        ("match {x} {y} --output {t}/m --solution guess", "guess"),
        ("match {x} {y} --output {t}/m --iterations 0", "at least 1"),
        ("match {x} {y} --output {t}/m --samples 5", "too few for 100 eigenvectors"),
        ("match {x} {y} --output {t}/m --samples 5000 --eigenvectors 20", "from 642 referenced vertices"),
        (
            "match {x} {y} --output {t}/m --init shout",
            "'shout' is not an initial map: choose from auto, shot, wks",
        ),
        ("match {x} {y} --output {t}/m --init map:", "map:"),
        ("match {x} {y} --output {t}/m --init map:{t}/missing.txt", "missing.txt"),
        ("match {x} {y} --output {t}/m --init landmarks:{x}", "x.off"),
        ("match {x} {y} --output {t}/m --report {x}", "is an input"),
        ("match {x} {y} --output {t}/m --ground-truth {t}/missing.vts {p}/y.vts", "missing.vts"),
        ("match {x} {y} --output {t}/m --ground-truth {p}/x.vts", "describes only one shape"),
        ("match {x} {y} --output {t}/m --precision float16", "float16"),
        ("match {x} {y} --output {t}/m --evaluation-samples -3", "at least 1"),
        ("match {x} {y} --output {x}", "would be overwritten"),
        ("match {x} {y} --output {t}/m --expected-error {t}/e.npy", "written as text"),
        (
            "match {x} {y} --output {p}/../{p.name}/truth.txt --ground-truth {p}/truth.txt",
            "would be overwritten",
        ),
        ("match {x} {y} --output {p}/truth.txt --init map:{p}/truth.txt", "would be overwritten"),
        (
            "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/x.vts {p}/y.vts --output {p}/y.vts",
            "overwritten",
        ),
        ("match {x} {y} --out {t}/m", "--output"),
        ("match {x} {y} --output . --alternatives 1", "not a file"),
        ("match {x} {y} --output {t}/m --alternatives 0", "at least 1"),
        ("match {x} {y} --output {t}/m --preset paper --alternatives 1", "--preset accurate"),
        ("match {x} {y} --output {t}/m --eigenvectors 20 --alternatives 1", "--preset accurate"),
        ("evaluate {x} {y} {p}/truth.txt", "--ground-truth"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --output {t}/no/e.json", "no/e.json"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --output {t}/e.csv", "ends in .json"),
        ("spectrum {x} --eigenvectors 642", "641"),
        ("spectrum {x} --bank regular --filters 6 --figure {t}/f.png", "is fixed"),
        ("spectrum {x} --filters 6", "--figure"),
        ("spectrum {x} --figure {x}", "would be overwritten"),
        ("demo --vertices 500 --output {t}/demo --init map:{t}/missing.txt", "missing.txt"),
        ("demo --vertices 500 --output {t}/demo --init shout", "shout"),
        ("spectrum {x} --output {t}/s.txt", ".npz, .safetensors or .mat"),
        ("spectrum {x} --figure {t}/s.nonsense", "s.nonsense"),
        ("render {x} {y} --output {t}/a.png", "give the map as the third file"),
        ("render {x} --output {t}/a.html", "page"),
        ("render {x} {y} {p}/truth.txt {p}/truth1.txt --output {t}/a.png", "one map"),
        ("render {x} {y} {p}/truth.txt --output {p}/truth.txt", "would be overwritten"),
        ("render {x} {y} {p}/truth.txt --partial --output {t}/a.png", "--partial"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --page {t}/e.png", ".html"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --up z", "--page"),
        ("evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --page {t}/no/e.html", "no/e.html"),
        ("render {x} --output {t}/a.nonsense", "a.nonsense"),
        ("demo --output {x}", "cannot be created as a directory"),
        ("demo --kind unicorn --output {t}/d", "unicorn"),
        ("demo --vertices 3 --output {t}/d", "3"),
        ("demo --vertices -5 --output {t}/d", "at least 1"),
        ("dance", "dance"),
        ("", "COMMAND"),
    ],
)
def test_hostile_arguments_are_refused(run, pair, tmp_path, arguments, fault):
    words = arguments.format(x=pair / "x.off", y=pair / "y.ply", p=pair, t=tmp_path).split()
    outcome = run(*words, *(["--quiet"] if len(words) > 1 else []))
    assert_refused(outcome, naming=fault)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("match x.off y.off --outptu m.txt", "unknown option '--outptu': did you mean --output?"),
        ("match x.off y.off --outptu=m.txt", "unknown option '--outptu': did you mean --output?"),
        ("match x.off y.off -output m.txt", "unknown option '-output': did you mean --output?"),
        ("match x.off y.off -o m.txt", "unknown option '-o' (see"),
        ("match x.off y.off --output m.txt --xyzzy", "unknown option '--xyzzy' (see"),
        (
            "transfer x.off y.off --registred r.off",
            "unknown option '--registred': did you mean --registered?",
        ),
        ("evaluate x.off y.off m.txt --groundtruth t.txt", "did you mean --ground-truth?"),
        ("benchmark data --method MWP", "did you mean --methods?"),
        ("spectrum x.off --eigenvectros 5", "did you mean --eigenvectors?"),
        ("render x.off --ouput p.png", "did you mean --output?"),
        ("demo --vertex 500", "did you mean --vertices?"),
        ("--verson", "jaxsmw: unknown option '--verson': did you mean --version?"),
        # These words are values, or options without their value.
        ("match x.off y.off --output m.txt --report r --up -z", "argument --up: expected one argument"),
        ("match x.off y.off --output m.txt --iterations -3", "at least 1"),
        ("match -- x.off --outptu", "--output"),
    ],
)
def test_a_mistyped_option_is_named_with_the_nearest_option(run, arguments, message):
    outcome = run(*arguments.split())
    assert_refused(outcome, naming=message)


def test_help_is_printed_beside_a_mistyped_option(run):
    assert run("match", "--outptu", "m.txt", "--help").output.startswith("usage: jaxsmw match")


@pytest.mark.parametrize(
    "outputs",
    [
        "--output {t}/z.png --figure {t}/z.png",
        "--output {t}/z.png --figure {t}/./z.png",
        "--output {t}/z.png --figure {t}/link/z.png",
        "--output {t}/z.html --page {t}/z.html",
        "--output {t}/link/z.html --page {t}/z.html",
        "--figure {t}/z.svg --page {t}/a.html --output {t}/link.svg",
    ],
)
def test_two_outputs_of_evaluate_in_one_file_are_refused(run, pair, tmp_path, outputs):
    (tmp_path / "link").symlink_to(tmp_path)
    (tmp_path / "link.svg").symlink_to(tmp_path / "z.svg")
    truth = pair / "truth.txt"
    call = ["evaluate", pair / "x.off", pair / "y.ply", truth, "--ground-truth", truth, "--quiet"]
    outcome = run(*call, *outputs.format(t=tmp_path).split())
    assert_refused(outcome, naming="two outputs have this name")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "link.svg"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("spectrum {x} --output {t}/s.npz --figure {t}/../{t.name}/s.npz", "two outputs have this name"),
        ("match {x} {y} --output {t}/m --report {t}/m/r", "is inside {t}/m, which is an output file"),
        ("demo --output {t}/d --init map:{t}/d/map.txt", "d/map.txt: is an input and would be overwritten"),
        ("benchmark {t} --pairs {t} --output {t}", "cannot be read as text"),
    ],
)
def test_clashing_paths_of_other_commands_are_refused(run, pair, tmp_path, arguments, fault):
    if "benchmark" in arguments:
        scape = [tmp_path / f"mesh00{number}.off" for number in range(2)]
        for path in scape:
            write_mesh(path, bumpy_mesh(1))
    words = arguments.format(x=pair / "x.off", y=pair / "y.ply", t=tmp_path).split()
    assert_refused(run(*words, "--quiet"), naming=fault.format(t=tmp_path))


# Each command line tests one option that takes a path. `{path}` is the path under test.
PATHS = {
    "SOURCE": "match {path} {y} --output {t}/m",
    "TARGET": "match {x} {path} --output {t}/m",
    "--output": "match {x} {y} --output {path}",
    "--surface-points": "match {x} {y} --output {t}/m --surface-points {path}",
    "--expected-error": "match {x} {y} --output {t}/m --expected-error {path}",
    "--one-to-one": "match {x} {y} --output {t}/m --one-to-one {path}",
    "--texture": "match {x} {y} --output {t}/m --texture {path}",
    "--report": "match {x} {y} --output {t}/m --report {path}",
    "--init": "match {x} {y} --output {t}/m --init map:{path}",
    "--ground-truth": "match {x} {y} --output {t}/m --ground-truth {path}",
    "MAP": "evaluate {x} {y} {path} --ground-truth {p}/truth.txt",
    "--figure": "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --figure {path}",
    "--page": "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --page {path}",
    "MESH": "spectrum {path}",
    "--output of spectrum": "spectrum {x} --output {path}",
    "--output of render": "render {x} --output {path}",
    "--output of demo": "demo --output {path}",
    "DATASET_DIRECTORY": "benchmark {path}",
    "--methods": "benchmark {t} --methods {path}",
    "--pairs": "benchmark {t} --pairs {path}",
    "--init of benchmark": "benchmark {t} --init {path}",
    "--output of benchmark": "benchmark {t} --output {path}",
}


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("kind", ["empty", "too long"])
def test_names_that_no_file_can_have_are_refused(run, pair, tmp_path, name, kind):
    if (name, kind) == ("--init", "empty"):
        pytest.skip("an empty path in --init is tested in test_hostile_arguments_are_refused")
    path = "" if kind == "empty" else "n" * 300
    words = PATHS[name].split()
    values = {"x": pair / "x.off", "y": pair / "y.ply", "p": pair, "t": tmp_path, "path": path}
    outcome = run(*(word.format(**values) for word in words), "--quiet")
    culprit, _, command = name.partition(" of ")
    assert_refused(outcome, naming=f"jaxsmw {command or words[0]}: argument {culprit}: ")
    assert ("is empty" if kind == "empty" else "File name too long") in outcome.errors
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        "match {x} {y} --output {t}/m --iterations",
        "match {x} {y} --output {t}/m --eigenvectors",
        "match {x} {y} --output {t}/m --samples",
        "match {x} {y} --output {t}/m --filters",
        "match {x} {y} --output {t}/m --alternatives",
        "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --evaluation-samples",
        "evaluate {x} {y} {p}/truth.txt --ground-truth {p}/truth.txt --evaluation-samples 3 --seed",
        "spectrum {x} --eigenvectors",
        "demo --output {t}/d --vertices",
        "demo --output {t}/d --seed",
        "benchmark {t} --workers",
        "benchmark {t} --seed",
    ],
)
@pytest.mark.parametrize("number", [2**31, 10**30, 10**5000], ids=["2^31", "10^30", "10^5000"])
def test_huge_numbers_are_refused(run, pair, tmp_path, arguments, number):
    words = arguments.format(x=pair / "x.off", y=pair / "y.ply", p=pair, t=tmp_path).split()
    text = "1" + "0" * 5000 if number > 10**40 else str(number)
    outcome = run(*words, text)
    assert_refused(outcome, naming=f"argument {words[-1]}: ")
    fault = "is not a whole number" if number > 10**40 else f"{number} is too large: give at most"
    assert fault in outcome.errors and len(outcome.errors) < 250
    assert list(tmp_path.iterdir()) == []


def test_the_largest_accepted_numbers_get_a_message_of_the_library(run, pair, tmp_path):
    call = ["match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet"]
    largest = 2**31 - 1
    assert_refused(run(*call, "--eigenvectors", largest), naming="choose a number from 1 to 641")
    assert_refused(run(*call, "--samples", largest), naming="from 642 referenced vertices")


def test_functions_refuse_names_that_are_too_long(tmp_path):
    path = tmp_path / ("n" * 300)
    for check in (check_writable, check_directory, make_directory):
        with pytest.raises(InputError, match=r"cannot be .*File name too long"):
            check(path)
    with pytest.raises(InputError, match=r"cannot be written \(File name too long"), atomic_write(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_too_little_memory_is_reported_in_one_sentence(run, pair, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise MemoryError("Unable to allocate 75.0 GiB")

    monkeypatch.setattr("jaxsmw.matching.match.match", fail)
    outcome = run("match", pair / "x.off", pair / "y.ply", "--output", tmp_path / "m", "--quiet")
    assert outcome.code == 1
    assert outcome.errors.count("\n") == 1
    assert_names(outcome.errors, "too little memory", "75.0 GiB", "smaller meshes", "eigenvectors", "samples")
