"""Landmark files: exact round trips, real files, damaged files, and the change between LPS and RAS."""

import codecs
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import assert_names, refused
from synthetic import sphere_mesh

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.geometry.surface_distance import bounding_box_diagonal, distances_to_surface
from jaxsmw.io import (
    Landmarks,
    check_frame,
    find_frame,
    match_landmarks,
    read_landmark_file,
    read_mesh,
    write_landmark_file,
)

NAMES = ("1", "nasal, left", 'the "tip"', "Größe µ", "a;b\\c", "#5", "x <&> 'y'", "=1+1", "F-1", "-2.5")
POSITIONS = np.random.default_rng(0).normal(size=(len(NAMES), 3)) * 10.0 ** np.arange(-12, 18, 3)[:, None]
WRITTEN = (".mrk.json", ".fcsv", ".pp", ".json", ".csv", ".txt")
PLAIN = (".tps", ".nts", ".pts")  # formats that cannot hold all names


def same(read: Landmarks, written: Landmarks) -> bool:
    return read.names == written.names and np.array_equal(read.positions, written.positions)


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("coordinates", ["LPS", "RAS", None])
def test_round_trips_are_exact(tmp_path, suffix, coordinates):
    landmarks = Landmarks(NAMES, POSITIONS, coordinates)
    path = tmp_path / f"points{suffix.upper()}"
    states_system = suffix in (".mrk.json", ".fcsv")
    if states_system and coordinates is None:
        with pytest.raises(InputError, match="state a coordinate system"):
            write_landmark_file(path, landmarks)
        assert not list(tmp_path.iterdir())
        return
    write_landmark_file(path, landmarks)
    again = read_landmark_file(path)
    assert same(again, landmarks)
    assert again.coordinates == (coordinates if states_system else None)
    assert (again.name, again.notes) == (str(path), ())


@pytest.mark.parametrize("suffix", PLAIN)
def test_morphometric_files_keep_positions_and_plain_names(tmp_path, suffix):
    path = tmp_path / f"points{suffix.upper()}"
    (note,) = write_landmark_file(path, Landmarks(NAMES, POSITIONS))
    again = read_landmark_file(path)
    assert np.array_equal(again.positions, POSITIONS) and again.coordinates is None
    numbers = tuple(map(str, range(1, len(NAMES) + 1)))
    if suffix == ".tps":
        assert again.names == numbers and "only numbered" in note
        plain = Landmarks(numbers, POSITIONS)
    else:
        assert again.names[:3] == ("1", "nasal,_left", "the__tip_") and "underscores" in note
        plain = Landmarks(("a-1", "Größe"), POSITIONS[:2])
    assert write_landmark_file(path, plain) == () and same(read_landmark_file(path), plain)
    # Two names that become equal stay distinct.
    write_landmark_file(path, Landmarks(("a b", "a_b"), POSITIONS[:2]))
    assert len(set(read_landmark_file(path).names)) == 2


def test_extreme_numbers_keep_all_digits(tmp_path):
    numbers = [[1 / 3, 5e-324, -0.0], [1e60, -1e60, 0.1 + 0.2], [1e22, 123456789.123456789, 2.0]]
    for suffix in (*WRITTEN, *PLAIN):
        landmarks = Landmarks(("a", "b", "c"), np.array(numbers), "RAS")
        write_landmark_file(tmp_path / f"p{suffix}", landmarks)
        assert (
            read_landmark_file(tmp_path / f"p{suffix}").positions.tobytes() == landmarks.positions.tobytes()
        )


def test_markups_files_keep_the_unit(tmp_path):
    read, written = tmp_path / "a.mrk.json", tmp_path / "b.mrk.json"
    write_landmark_file(read, Landmarks(("a",), np.array([[1.0, 2, 3]]), "LPS"))
    assert read_landmark_file(read).unit is None
    document = json.loads(read.read_text("utf-8"))
    for unit in ("mm", "um", "µm \ud800"):
        document["markups"][0]["coordinateUnits"] = unit
        read.write_text(json.dumps(document))
        landmarks = read_landmark_file(read)
        write_landmark_file(written, landmarks.in_coordinates("RAS").select(["a"]))
        assert landmarks.unit == read_landmark_file(written).unit == unit
        assert json.loads(written.read_text("utf-8"))["markups"][0]["coordinateUnits"] == unit
    for unit in (3, ["mm"], {"mm": 1}, False):
        document["markups"][0]["coordinateUnits"] = unit
        read.write_text(json.dumps(document))
        landmarks = read_landmark_file(read)
        assert landmarks.unit is None and "not text" in landmarks.notes[0]


def test_markups_files_have_the_fields_of_the_schema(tmp_path):
    path = tmp_path / "p.mrk.json"
    write_landmark_file(path, Landmarks(("a", "b"), np.array([[1.0, 2, 3], [4, 5, 6]]), "LPS"))
    document = json.loads(path.read_text("utf-8"))
    assert re.search(r"markups-schema-v1\.0\.3\.json#$", document["@schema"])
    (markup,) = document["markups"]
    assert (markup["type"], markup["coordinateSystem"]) == ("Fiducial", "LPS")
    assert "coordinateUnits" not in markup  # the unit is not known
    for number, point in enumerate(markup["controlPoints"], start=1):
        assert point["id"] == str(number) and point["positionStatus"] == "defined"
        assert [type(value) for value in point["position"]] == [float] * 3  # Slicer refuses integers
        assert len(point["orientation"]) == 9
    assert '"controlPoints": [\n{"id": "1", "label": "a"' in path.read_text("utf-8")


def test_other_formats_begin_as_their_programs_expect(tmp_path):
    landmarks = Landmarks(("a,b", "c"), np.array([[1.0, 2, 3], [4, 5, 6]]), "RAS")
    expected = {
        ".fcsv": '# Markups fiducial file version = 4.11\n# CoordinateSystem = RAS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n1,1.0,2.0,3.0,0,0,0,1,1,1,0,"a,b",,\n',
        ".pp": "<!DOCTYPE PickedPoints>\n<PickedPoints>\n",
        ".csv": 'name,x,y,z\n"a,b",1.0,2.0,3.0\nc,4.0,5.0,6.0\n',
        ".txt": "name\tx\ty\tz\na,b\t1.0\t2.0\t3.0\n",
    }
    for suffix, beginning in expected.items():
        write_landmark_file(tmp_path / f"p{suffix}", landmarks)
        assert (tmp_path / f"p{suffix}").read_bytes().decode().startswith(beginning), suffix


EXPECTED = Landmarks(("a", "b"), np.array([[1.0, 2.0, 3.0], [-4.5, 0.5, 600.0]]))
UNNAMED = Landmarks(("1", "2"), EXPECTED.positions)
FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
POINT = "<point><id>{}</id><specification>0</specification><x>{}</x><y>{}</y><z>{}</z></point>"
PLACES = POINT.format(0, 1, 2, 3) + POINT.format(1, -4.5, 0.5, 600)
MPS = "<point_set_file><point_set><time_series><time_series_id>0</time_series_id>{}</time_series></point_set></point_set_file>"


@pytest.mark.parametrize(
    ("name", "text", "expected", "coordinates"),
    [
        ("p.csv", "name,x,y,z\na,1,2,3\nb,-4.5,.5,6e2\n", EXPECTED, None),
        ("p.csv", "X,Y,Z,Label\n1,2,3,a\n-4.5,+.5,6E2,b\n", EXPECTED, None),
        ("p.csv", "a, 1, 2, 3\r\n\r\nb, -4.5, 0.5, 600\r\n,,,\r\n", EXPECTED, None),
        ("p.csv", "\ufeffa;1;2;3\rb;-4.5;0.5;600", EXPECTED, None),
        ("p.txt", "a\t1\t2\t3\nb\t-4.5\t0.5\t600", EXPECTED, None),
        ("p.txt", "  a   1 2\t3 \n b -4.5  0.5 600\n\n", EXPECTED, None),
        ("p.txt", '"a" 1 2 3\nb -4.5 0.5 600', EXPECTED, None),
        ("p.txt", "1 2 3\n-4.5 0.5 600", UNNAMED, None),
        ("p.csv", "x,y,z\n1,2,3\n-4.5,0.5,600", UNNAMED, None),
        ("p.csv", '"","x","y","z"\n"a",1,2,3\n"b",-4.5,0.5,600', EXPECTED, None),
        ("p.csv", ",1,2,3\n,-4.5,0.5,600", UNNAMED, None),
        ("p.fcsv", FCSV.format("0") + "1,1,2,3,0,0,0,1,1,1,0,a,,\n2,-4.5,0.5,600,0,0,0,1,1,1,0,b,,", EXPECTED, "RAS"),
        ("p.fcsv", FCSV.format("1") + "1,1,2,3,0,0,0,1,1,1,0,a,,,2,0\n2,-4.5,0.5,600,0,0,0,1,1,1,0,b,,,2,0\n", EXPECTED, "LPS"),
        ("p.fcsv", FCSV.format("LPS") + '1,1,2,3,0,0,0,1,1,1,0,,"x, y",\n2,-4.5,0.5,600,0,0,0,1,1,1,0,,,', UNNAMED, "LPS"),
        ("p.fcsv", "# CoordinateSystem = RAS\n# columns = label,x,y,z,sel,vis\na,1,2,3,1,1\nb,-4.5,0.5,600,1,1\n", EXPECTED, "RAS"),
        ("p.fcsv", "# Markups fiducial file version = 4.6\n1,1,2,3,0,0,0,1,1,1,0,a,,\n2,-4.5,0.5,600,0,0,0,1,1,1,0,b,,", EXPECTED, None),
        ("p.pp", '<PickedPoints><point x="1" y="2" z="3" name="a"/><point active="1" name="b" z="600" y=".5" x="-4.5"/></PickedPoints>', EXPECTED, None),
        ("p.pp", '<?xml version="1.0" encoding="UTF-8"?><!DOCTYPE PickedPoints><PickedPoints><point x="1" y="2" z="3"/><point name=" " z="600" y=".5" x="-4.5"/></PickedPoints>', UNNAMED, None),
        ("p.mps", MPS.format(PLACES), UNNAMED, "LPS"),
        ("p.tps", "LM3=2\n1 2 3\n-4.5 .5 6e2\nIMAGE=a.png\nID=skull 3\n", UNNAMED, None),
        ("p.tps", "lm=2\r\n1 2 3\r\n-4.5 0.5 600\r\n", UNNAMED, None),
        ("p.nts", '"a skull\n1 2 3 0 dim=3\n1 2 3\n-4.5 0.5 600\n', UNNAMED, None),
        ("p.nts", "1 2L 3 0 DIM=3\na b\n1 2 3\n-4.5 0.5 600\n", EXPECTED, None),
        ("p.nts", "1 1L 6 1 9999 Dim=3\nskull3\n1 2 3\n-4.5 0.5 600\n", UNNAMED, None),
        ("p.pts", "Version 1.0\n2\na  1.0 2.0 3.0\nb -4.5 .5 6e2\n", EXPECTED, None),
        ("p.pts", "version: 1\nn_points: 2\n{\n1 2 3\n-4.5 0.5 600\n}\n", UNNAMED, None),
        ("p.pts", "1 2 3\n-4.5 0.5 600\n", UNNAMED, None),
        ("p.json", '[{"id":"a","coordinates":[1,2,3]},{"id":"b","description":"x","coordinates":[-4.5,0.5,6e2]}]', EXPECTED, None),
        ("p.mps", f"<point_set_file><point_set>{PLACES}</point_set></point_set_file>", UNNAMED, "LPS"),
    ],
)  # fmt: skip
def test_variants_of_each_format(tmp_path, name, text, expected, coordinates):
    (tmp_path / name).write_bytes(text.encode())
    landmarks = read_landmark_file(tmp_path / name)
    assert same(landmarks, expected), landmarks
    assert landmarks.coordinates == coordinates
    assert bool(landmarks.notes) == (name == "p.fcsv" and coordinates is None)


def markups(*points: object, **properties: object) -> str:
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points, **properties}
    return json.dumps({"@schema": "…", "markups": [markup]})


def point(label: str, *position: object, **properties: object) -> dict[str, object]:
    return {"label": label, "position": position, **properties}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("p.tps", "LM3=2\nnan NaN nan\n1 2 3\nSCALE=0.5\n"),
        ("p.nts", "1 2 3 1 -999 dim=3\n-999 -999 -999\n1 2 3\n"),
        ("p.pts", "Version 1.0\n2\nS000 9999 9999 9999\nS001 1 2 3\n"),
    ],
)
def test_missing_landmarks_of_morphometric_files_are_left_out(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    landmarks = read_landmark_file(tmp_path / name)
    assert landmarks.positions.tolist() == [[1, 2, 3]] and landmarks.names == (
        "S001" if name == "p.pts" else "2",
    )
    assert "1 of 2 points left out" in landmarks.notes[-1]
    assert (name == "p.tps") == (landmarks.notes[0] == "The lines SCALE were ignored.")


def test_slicers_files_may_be_called_json(tmp_path):
    write_landmark_file(tmp_path / "a.mrk.json", EXPECTED.stated("RAS"))
    (tmp_path / "a.mrk.json").rename(tmp_path / "a.json")
    assert same(read_landmark_file(tmp_path / "a.json"), EXPECTED)


def test_undefined_points_are_left_out_with_a_note(tmp_path):
    path = tmp_path / "p.mrk.json"
    undefined = {"label": "c", "position": [0, 0, 0], "positionStatus": "undefined"}
    path.write_text(
        markups(undefined, point("", 1, 2, 3), {"positionStatus": "preview"}, point("a", 4, 5, 6))
    )
    landmarks = read_landmark_file(path)
    assert landmarks.names == ("2", "a") and landmarks.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    (note,) = landmarks.notes
    assert_names(note, "2 of 4", "left out", "no defined position", "1, 3")
    path = tmp_path / "p.fcsv"
    path.write_text(FCSV.format("LPS") + "1,1,2,3,0,0,0,1,1,1,0,a,,,0,0\n2,1,2,3,0,0,0,1,1,1,0,b,,,2,0\n")
    assert read_landmark_file(path).names == ("b",) and "number 1." in read_landmark_file(path).notes[0]
    path = tmp_path / "p.pp"
    path.write_text('<PickedPoints><point active="0" name="a"/><point x="1" y="2" z="3"/></PickedPoints>')
    assert read_landmark_file(path).names == ("2",) and "not active" in read_landmark_file(path).notes[0]


@pytest.mark.parametrize(
    ("stated", "expected"), [("RAS", "RAS"), ("LPS", "LPS"), ("0", "RAS"), ("1", "LPS"), (None, "LPS")]
)
def test_coordinate_systems_of_markups(tmp_path, stated, expected):
    text = markups(point("a", 1, 2, 3), **({} if stated is None else {"coordinateSystem": stated}))
    if stated is None:
        text = text.replace('"coordinateSystem": "LPS", ', "")
    (tmp_path / "p.mrk.json").write_text(text)
    landmarks = read_landmark_file(tmp_path / "p.mrk.json")
    assert landmarks.coordinates == expected
    assert bool(landmarks.notes) == (stated is None)  # a default is never applied silently


def test_point_sets_of_mitk_are_moved_to_world_coordinates(tmp_path):
    matrix = " ".join(f'm_{r}_{c}="{v}"' for (r, c), v in np.ndenumerate([[0, 2, 0], [1, 0, 0], [0, 0, -1]]))
    geometry = f'<Geometry3D><IndexToWorld {matrix}/><Offset x="10" y="20" z="30"/></Geometry3D>'
    (tmp_path / "p.mps").write_text(MPS.format(geometry + POINT.format(4, 1, 2, 3)))
    landmarks = read_landmark_file(tmp_path / "p.mps")
    assert landmarks.names == ("5",) and landmarks.positions.tolist() == [[14, 21, 27]]


BOMB = '<!DOCTYPE PickedPoints [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
A = point("a", 1, 2, 3)
HOSTILE = [
    ("p.csv", "", "is empty"),
    ("p.csv", " \n\n\t\n", "is empty"),
    ("p.csv", ",,,\n,,,\n", "is empty"),
    ("p.csv", "name,x,y,z\n", "contains no landmarks"),
    ("p.csv", "a,1,2,3\nb,1,2\n", "line 2 has 3 values instead of 4"),
    ("p.csv", "a,1,2,3\nb,1,2,3,4\n", "line 2 has 5 values instead of 4"),
    ("p.csv", "1 2\n3 4\n", "line 1 has 2 values"),
    ("p.csv", "a,1,2,3\n\na,4,5,6\n", "line 1 and line 3 have the same name 'a'"),
    ("p.csv", "2,1,2,3\n,4,5,6\n", "line 1 and line 2 have the same name '2'"),
    ("p.csv", "a,1,2,nan\n", "'nan' where a coordinate should be"),
    ("p.csv", "a,1,2,3\nb,1,-inf,3\n", "line 2 has '-inf'"),
    ("p.csv", "a,1,2,1e999\n", "line 1 has a coordinate that is not a finite number"),
    ("p.csv", "a,1,2,1e61\n", "below 1e60"),
    ("p.csv", "a,1,2,1_0\n", "'1_0'"),
    ("p.csv", "a,1,2,٣\n", "where a coordinate should be"),
    ("p.csv", "a,1,2,\n", "has '' where a coordinate should be"),
    ("p.csv", "a;1,5;2,5;3,5\n", "write decimals with a point"),
    ("p.csv", 'a,1,2,3\n"b,1,2,3\n', "quotes near line"),
    ("p.csv", 'c,1,2,3\n"a\nb",1,2,3\n', "the name in line 3 contains a line break"),
    ("p.csv", "a\x07b,1,2,3\n", "control character"),
    ("p.csv", "a,1,2,3\0\n", "null characters"),
    ("p.csv", b"\xff\xfea\x00,\x001\x00", "UTF-16"),
    ("p.csv", "a,1,2,3\n".encode("utf-16-be"), "null characters"),
    ("p.csv", codecs.BOM_UTF16_BE + "a,1,2,3\n".encode("utf-16-be"), "UTF-16"),
    ("p.csv", "Größe,1,2,3\n".encode("latin-1"), "not text in UTF-8"),
    ("p.csv", "1," * 2**17, "more than 65536 characters"),
    ("p.csv", "mesh,landmark,x,y,z\nm.off,1,1,2,3\n", "the column 'mesh'"),
    ("p.csv", "name,label,x,y,z\na,b,1,2,3\n", "the column 'label'"),
    ("p.csv", "name,x,y\na,1,2\n", "neither a landmark nor"),
    ("p.csv", "name,x,x,y,z\na,1,2,3,4\n", "neither a landmark nor"),
    ("p.txt", "upper left 1 2 3\n", "double quotes"),
    ("p.txt", "OFF\n3 1 0\n", "neither a landmark nor"),
    ("p.fcsv", "1,1,2,3\n", "lacks the line"),
    ("p.fcsv", FCSV.format("2") + "1,1,2,3,0,0,0,1,1,1,0,a,,", "'2' is neither LPS"),
    ("p.fcsv", FCSV.format("LPS") + "1,1,2,3,0,0,0,1,1", "line 4 has 9 values instead of 14"),
    ("p.fcsv", FCSV.format("LPS"), "contains no landmarks"),
    ("p.fcsv", FCSV.format("LPS").replace(",z,", ",x,") + "1,1,2,3,0,0,0,1,1,1,0,a,,", "does not name x, y and z"),
    ("p.fcsv", FCSV.format("LPS") + '1,1,2,3,0,0,0,1,1,1,0,"a' + "b" * 2**16, "characters"),
    ("p.fcsv", FCSV.format("LPS") + '1,1,2,3,0,0,0,1,1,1,0,"a' + "b\n" * 2**17, "quotes near line"),
    ("p.mrk.json", markups(A)[:-3], "not a complete JSON file"),
    ("p.mrk.json", "[" * 100_000, "not a complete JSON file"),
    ("p.mrk.json", '{"a":' * 100_000, "not a complete JSON file"),
    ("p.mrk.json", "[1]", "is not a Markups file"),
    ("p.mrk.json", '{"markups": {}}', "is not a Markups file"),
    ("p.mrk.json", '{"markups": [3]}', "is not a Markups file"),
    ("p.mrk.json", '{"markups": []}', "contains 0 markups"),
    ("p.mrk.json", '{"markups": [{}, {}]}', "contains 2 markups"),
    ("p.mrk.json", '{"markups": [], "markups": []}', "states a property twice"),
    ("p.mrk.json", markups(A, type="Curve"), "'Curve'"),
    ("p.mrk.json", markups(A, type=[[]]), "is a list"),
    ("p.mrk.json", markups(A, coordinateSystem="IJK"), "'IJK' is neither"),
    ("p.mrk.json", markups(A, coordinateSystem=[0]), "neither"),
    ("p.mrk.json", markups(), "contains no landmarks"),
    ("p.mrk.json", markups(controlPoints={}), "controlPoints is not a list"),
    ("p.mrk.json", markups(A, 3), "control point 2 is not an object"),
    ("p.mrk.json", markups({"label": "a"}), "position that is not a list of three numbers"),
    ("p.mrk.json", markups(point("a", 1, 2)), "three numbers"),
    ("p.mrk.json", markups(point("a", 1, 2, True)), "three numbers"),
    ("p.mrk.json", markups(point("a", 1, 2, "3")), "three numbers"),
    ("p.mrk.json", markups(point("a", 1, 2, float("nan"))), "not a finite number"),
    ("p.mrk.json", markups(A).replace("[1, 2", f"[{'9' * 5000}, 2"), "not a finite number"),
    ("p.mrk.json", markups({**A, "label": 5}), "label that is not text"),
    ("p.mrk.json", markups({**A, "label": "\ud800"}), "control character"),
    ("p.mrk.json", markups({**A, "positionStatus": "odd"}), "unknown position status 'odd'"),
    ("p.mrk.json", markups({**A, "positionStatus": "undefined"}), "contains no landmarks"),
    ("p.mrk.json", markups(A, point("b", 1, 2, 3), A), "control point 1 and control point 3 have the same name"),
    ("p.pp", "<PickedPoints><point x='1' y='2' z='3'/>", "not a complete XML file"),
    ("p.pp", "<PickedPoints></PickedPoints>", "contains no landmarks"),
    ("p.pp", "<Other></Other>", "is not a PickedPoints file"),
    ("p.pp", BOMB + "<PickedPoints><point x='1' y='2' z='3' name='&b;'/></PickedPoints>", "DOCTYPE"),
    ("p.pp", '<!DOCTYPE PickedPoints SYSTEM "file:///etc/hostname"><PickedPoints/>', "DOCTYPE"),
    ("p.pp", "<PickedPoints><point x='1' y='2' z='3' name='&b;'/></PickedPoints>", "not a complete XML file"),
    ("p.pp", "<PickedPoints>" + "<a>" * 100_000, "nested elements"),
    ("p.pp", "<PickedPoints " + "".join(f"a{i}='' " for i in range(10_000)) + "/>", "more than 65536 characters"),
    ("p.pp", "<PickedPoints><point x='1' y='2'/></PickedPoints>", "point 1 has no z"),
    ("p.pp", "<PickedPoints><point x='1' y='2' z='1,5'/></PickedPoints>", "'1,5'"),
    ("p.pp", "<PickedPoints><point x='1' y='2' z='3'/><point x='1' y='2' z='3' name='1'/></PickedPoints>", "point 1 and point 2"),
    ("p.mps", MPS.format(""), "contains no landmarks"),
    ("p.mps", MPS.format(POINT.format(0, 1, 2, 3) * 2), "point 1 and point 2 have the same name '1'"),
    ("p.mps", MPS.format(POINT.format("-1", 1, 2, 3)), "not a whole number"),
    ("p.mps", MPS.format(POINT.format(0, 1, 2, 3).replace("<z>3</z>", "")), "point 1 has no z"),
    ("p.mps", MPS.format(POINT.format(0, 1, 2, 3).replace("<z>3</z>", "<z>3</z><z>4</z>")), "states its 'z' twice"),
    ("p.mps", MPS.format("</time_series><time_series>"), "several point sets or time steps"),
    ("p.mps", MPS.format("<Geometry3D><Offset x='1'/></Geometry3D>" + PLACES), "Geometry3D lacks a number"),
    ("p.txt", "1 2 3\n" * (2**20 + 1), "more than 1048576 landmarks"),
    ("p.pp", "<PickedPoints>" + "<point />" * (2**20 + 1), "more than 1048576 landmarks"),
    ("p.vtk", "a,1,2,3\n", "suffix '.vtk'"),
    ("p.tps", "1 2 3\n", "has no line LM3=NUMBER"),
    ("p.tps", "LM=2\n1 2\n3 4\n", "2 coordinates instead of three"),
    ("p.tps", "LM3=x\n1 2 3\n", "line 1 does not state the number"),
    ("p.tps", "LM3=3\n1 2 3\n", "declares 3 landmarks, but contains 1"),
    ("p.tps", "LM3=1\n1 2 3\n4 5 6\n", "has more than the declared 1 landmark"),
    ("p.tps", "LM3=1\n1 2 3\nID=a\nLM3=1\n1 2 3\nID=b\n", "contains 2 specimens"),
    ("p.tps", "LM3=1\n1 2 3,5\n", "write decimals with a point"),
    ("p.tps", "LM3=0\nID=a\n", "contains no landmarks"),
    ("p.nts", "1 2 3\n4 5 6\n", "header of an NTSYS matrix"),
    ("p.nts", "2 2 3 0\n1 2 3\n4 5 6\n", "header of an NTSYS matrix"),
    ("p.nts", '"only a comment\n', "header of an NTSYS matrix"),
    ("p.nts", "1 2 2 0 dim=2\n1 2\n3 4\n", "landmarks with 2 coordinates"),
    ("p.nts", "1 5 30 0 dim=3\n1 2 3\n", "contains 5 rows of 30 numbers"),
    ("p.nts", "1 3 3 0 dim=3\n1 2 3\n4 5 6\n", "declares 3 landmarks, but contains 2"),
    ("p.nts", "1 2L 3 0 dim=3\na a\n1 2 3\n4 5 6\n", "the same name 'a'"),
    ("p.nts", "1 1L 3 0 dim=3\n1 2 3\n", "but contains 0"),
    ("p.pts", "Version 1.0\n3\nS0 1 2 3\n", "declares 3 landmarks, but contains 1"),
    ("p.pts", "Version 1.0\nS0 1 2 3\n", "line 2 does not state the number"),
    ("p.pts", "Version 1.0\n", "line 2 does not state the number"),
    ("p.pts", "Version 1.0\n1\nS0 1 2\n", "2 coordinates instead of three"),
    ("p.pts", "version: 1\nn_points: 1\n{\n1 2\n}\n", "landmarks of a mesh, not of a picture"),
    ("p.pts", "version: 1\nn_points: 2\n{\n1 2 3\n}\n", "declares 2 landmarks, but contains 1"),
    ("p.pts", "version: 1\nn_points: 1\n{\n1 2 3\n", "between braces"),
    ("p.json", "[{}]", "coordinates that are not a list"),
    ("p.json", "[1]", "neither a list of landmarks of Scalismo nor"),
    ("p.json", '{"id": "a"}', "neither a list of landmarks of Scalismo nor"),
    ("p.json", '[{"id": 3, "coordinates": [1, 2, 3]}]', "an id that is not text"),
    ("p.json", '[{"id": "a", "coordinates": [1, 2]}]', "three numbers"),
    ("p.json", "[]", "contains no landmarks"),
    ("p", "a,1,2,3\n", "suffix ''"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "fault"), HOSTILE, ids=map(str, range(len(HOSTILE))))
def test_damaged_files_cause_one_clear_sentence(tmp_path, name, content, fault):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    with pytest.raises(InputError) as refusal:
        read_landmark_file(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ") and fault in message, message
    assert message.endswith(".") and len(message) - len(str(path)) < 260 and "\n" not in message
    assert message.count(str(path)) == 1


@pytest.mark.parametrize("suffix", [*WRITTEN, ".mps"])
def test_no_truncated_file_is_read_with_a_wrong_position(tmp_path, suffix):
    """A file that ends early is refused, or its complete landmarks are read, and the last number of a table
    may lose digits only if the file gives no sign of its end."""
    landmarks = Landmarks(("a", "b", "c"), np.arange(9.0).reshape(3, 3) + 0.25, "LPS")
    path = tmp_path / f"p{suffix}"
    if suffix == ".mps":
        path.write_text(MPS.format("".join(POINT.format(i, *landmarks.positions[i]) for i in range(3))))
    else:
        write_landmark_file(path, landmarks)
    data = path.read_bytes().rstrip()
    for length in range(0, len(data), 1 if suffix in (".csv", ".txt") else 8):
        path.write_bytes(data[:length])
        try:
            read = read_landmark_file(path)
        except InputError:
            continue
        assert suffix in (".csv", ".txt", ".fcsv")
        complete = len(read) - (suffix != ".fcsv")
        assert np.array_equal(read.positions[:complete], landmarks.positions[:complete])


def test_files_that_cannot_be_written_leave_nothing_behind(tmp_path):
    landmarks = Landmarks(("a",), np.zeros((1, 3)), "LPS")
    for name in ("p.mps", "p.vtk", "p.xml", "missing/p.csv"):
        with pytest.raises(InputError):
            write_landmark_file(tmp_path / name, landmarks)
    assert not list(tmp_path.iterdir())


def test_too_large_files_are_refused_unread(tmp_path):
    for suffix, size in ((".csv", 2**27), (".mrk.json", 2**25)):
        with (tmp_path / f"p{suffix}").open("wb") as file:
            file.truncate(size + 1)  # the file has no contents on the disk
        with pytest.raises(InputError, match=f"larger than {size >> 20} MiB"):
            read_landmark_file(tmp_path / f"p{suffix}")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("names", "positions", "coordinates", "fault"),
    [
        ((), np.zeros((0, 3)), None, "no landmarks"),
        (("a", "a"), np.zeros((2, 3)), None, "same name 'a'"),
        (("a", ""), np.zeros((2, 3)), None, "is empty"),
        ((" a",), np.zeros((1, 3)), None, "begins or ends with a blank"),
        (("a\nb",), np.zeros((1, 3)), None, "line break"),
        (("a",), np.zeros((2, 3)), None, "shape"),
        (("a",), np.full((1, 3), np.nan), None, "finite"),
        (("a",), np.zeros((1, 3)), "IJK", "'IJK' is not a coordinate system"),
    ],
)
def test_impossible_landmarks_are_refused(names, positions, coordinates, fault):
    with pytest.raises(InputError, match=fault):
        Landmarks(names, positions, coordinates)


def test_coordinate_systems_differ_in_the_signs_of_x_and_y():
    lps = Landmarks(("a",), np.array([[1.0, 2.0, 3.0]]), "LPS")
    ras = lps.in_coordinates("RAS")
    assert ras.positions.tolist() == [[-1, -2, 3]] and ras.coordinates == "RAS"
    assert same(ras.in_coordinates("LPS"), lps) and lps.in_coordinates("LPS") is lps
    unknown = Landmarks(("a",), lps.positions)
    assert unknown.flipped().coordinates is None and same(unknown.flipped(), ras)
    with pytest.raises(InputError, match="not known"):
        unknown.in_coordinates("RAS")


def test_landmarks_are_matched_by_name():
    first = Landmarks(("c", "a", "x", "b"), np.arange(12.0).reshape(4, 3))
    second = Landmarks(("a", "b", "c", "y"), np.arange(12.0).reshape(4, 3))
    match = match_landmarks(first, second)
    assert match == (("c", "a", "b"), ("x",), ("y",))
    assert first.select(match.names).positions[:, 0].tolist() == [0, 3, 9]
    assert second.select(match.names).positions[:, 0].tolist() == [6, 0, 3]
    with pytest.raises(InputError, match="has no landmark with the name"):
        match_landmarks(first, Landmarks(("A",), np.zeros((1, 3))))
    with pytest.raises(InputError, match="'y'"):
        first.select(["y"])


def shifted_sphere() -> Mesh:
    vertices, faces = sphere_mesh(3)
    return make_mesh(vertices + np.array([3.0, -4.0, 5.0]), faces, name="sphere")


def test_distances_to_a_surface_are_exact():
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [9, 9, 9]])  # the last vertex is in no face
    mesh = make_mesh(vertices, [[0, 1, 2]])
    points = np.array([[1.0, 1, 2], [-3, -4, 0], [4, 4, 0], [9, 9, 9], [0, 0, 0]])
    beyond = np.hypot(np.hypot(7, 7), 9)
    expected = [2, 5, np.sqrt(8), beyond, 0]
    np.testing.assert_allclose(distances_to_surface(points, mesh), expected, atol=1e-12)
    assert distances_to_surface(points[:1], mesh).shape == (1,)
    assert distances_to_surface(points[:0], mesh).shape == (0,)
    assert bounding_box_diagonal(mesh) == pytest.approx(np.sqrt(32))


@pytest.mark.parametrize(("coordinates", "named"), [("LPS", "to RAS: set coordinates=\"RAS\""), (None, "signs of x and y")])  # fmt: skip
def test_a_missing_change_of_coordinates_is_found_and_named(coordinates, named):
    mesh = shifted_sphere()
    right = Landmarks(("a", "b", "c"), mesh.vertices[[0, 50, 100]], coordinates, name="points.csv")
    assert check_frame(right, mesh) == ()
    assert find_frame(right, mesh).as_read == pytest.approx(0, abs=1e-9)
    assert find_frame(right, mesh).flipped == find_frame(right.flipped(), mesh).as_read > 5
    wrong = Landmarks(right.names, right.flipped().positions, coordinates, name="points.csv")
    with pytest.raises(InputError) as refusal:
        check_frame(wrong, mesh)
    assert named in str(refusal.value) and str(refusal.value).startswith("points.csv: ")
    assert "sphere" in str(refusal.value)


def test_single_landmarks_off_the_surface_cause_a_warning():
    mesh = shifted_sphere()
    positions = mesh.vertices[[0, 50, 100]] + [[0, 0, 0], [0, 0, 0], [0, 0, 9]]
    (warning,) = check_frame(Landmarks(("a", "b", "c"), positions), mesh)
    assert "'c' is " in warning and warning.endswith("% of the diagonal of the mesh.")
    # Neither frame and no other unit fits, so the message suggests no change.
    elsewhere = Landmarks(("a", "b"), (mesh.vertices + 0.5 * mesh.vertex_normals)[[0, 50]])
    with refused("landmarks of this mesh", "unit", "coordinates"):
        check_frame(elsewhere, mesh)


@pytest.mark.parametrize("centered", [False, True])
@pytest.mark.parametrize(("factor", "cure"), [(1000, "0.001"), (0.001, "1000"), (1 / 25.4, "25.4")])
def test_landmarks_in_another_unit_are_refused(centered, factor, cure):
    """Landmarks that shrink towards the middle of a centred mesh are inside of the mesh."""
    mesh = shifted_sphere()
    if centered:
        mesh = replace(mesh, vertices=mesh.vertices - mesh.vertices.mean(axis=0))
    scaled = Landmarks(("a", "b", "c"), factor * mesh.vertices[[0, 50, 90]], name="points.csv")
    with pytest.raises(
        InputError, match=rf"points.csv: .* but its diagonal is 3.46: multiply the positions by {cure},"
    ):
        check_frame(scaled, mesh)


def test_a_real_skull(shared, tmp_path):
    landmarks = read_landmark_file(shared / "data/mouse_skulls/CAST_EIJ.mrk.json")
    mesh = read_mesh(shared / "data/mouse_skulls/CAST_EIJ.ply")
    assert len(landmarks) == 51 and landmarks.coordinates == "LPS" and landmarks.names[:2] == ("1", "2")
    assert check_frame(landmarks, mesh) == ()
    assert find_frame(landmarks, mesh).as_read < 0.002 * bounding_box_diagonal(mesh)
    with pytest.raises(InputError, match='from RAS to LPS: set coordinates="LPS"'):
        check_frame(landmarks.in_coordinates("RAS"), mesh)
    for suffix in WRITTEN:
        write_landmark_file(tmp_path / f"p{suffix}", landmarks)
        assert same(read_landmark_file(tmp_path / f"p{suffix}"), landmarks)


def legacy_vtk(path: Path) -> Mesh:
    """Read the triangles of a binary file in the legacy VTK format."""
    data = path.read_bytes()
    points, polygons = (
        re.search(pattern, data) for pattern in (rb"POINTS (\d+) float\n", rb"POLYGONS \d+ (\d+)\n")
    )
    vertices = np.frombuffer(data, ">f4", 3 * int(points[1]), points.end()).reshape(-1, 3)
    faces = np.frombuffer(data, ">i4", int(polygons[1]), polygons.end()).reshape(-1, 4)[:, 1:]
    return make_mesh(vertices.astype(np.float64), faces.astype(np.int64))  # fmt: skip


def test_real_mandibles(shared):
    for table in sorted((shared / "data/mouse_mandibles").glob("*.csv")):
        mesh = legacy_vtk(table.with_suffix(".vtk"))
        for path, count, coordinates in ((table, 17, None), (table.with_suffix(".mps"), 12, "LPS")):
            landmarks = read_landmark_file(path)
            assert landmarks.names == tuple(str(i) for i in range(1, count + 1))
            assert landmarks.coordinates == coordinates
            assert find_frame(landmarks, mesh).as_read < 0.003 * bounding_box_diagonal(mesh)


def test_a_table_of_many_meshes_is_refused(shared):
    with pytest.raises(InputError, match="the column 'mesh'"):
        read_landmark_file(shared / "data/primate_molars/landmarks.csv")


@pytest.mark.slow
def test_many_lines(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("".join(f"L{i},{i},0.5,-{i}e-3\n" for i in range(10**5)))
    landmarks = read_landmark_file(path)
    assert len(landmarks) == 10**5 and landmarks.positions[-1].tolist() == [99_999, 0.5, -99.999]
