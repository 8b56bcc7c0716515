import numpy as np
import pytest

from real2sim_server.scene import BundleError
from real2sim_server.scene.io.ply import (
    MAX_HEADER_BYTES,
    MAX_HEADER_LINES,
    read_ply_elements,
    read_ply_header,
)

HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    "property float x\nproperty uchar label\nproperty double t\nend_header\n"
)
RECORDS = np.array(
    [(1.5, 7, -2.0), (0.25, 255, 1e300), (-3, 0, 0.1)],
    dtype=[("x", "<f4"), ("label", "u1"), ("t", "<f8")],
)


@pytest.fixture
def ply(tmp_path):
    def write(header: str = HEADER, data: bytes = RECORDS.tobytes()):
        file = tmp_path / "file.ply"
        file.write_bytes(header.encode("latin-1") + data)
        return file

    return write


def test_records_of_mixed_types_are_read(ply):
    np.testing.assert_array_equal(read_ply_elements(ply())["vertex"], RECORDS)


def test_big_endian_is_read(ply):
    swapped = RECORDS.astype([("x", ">f4"), ("label", "u1"), ("t", ">f8")])
    vertex = read_ply_elements(ply(HEADER.replace("little", "big"), swapped.tobytes()))["vertex"]
    for name in ("x", "label", "t"):
        np.testing.assert_array_equal(vertex[name], RECORDS[name])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("element vertex", "comment made by hand, end_header is next\nobj_info x\nelement vertex"),
        ("ply\n", "ply\ncomment first\n"),
        ("float x", "float32 x"),
        ("\n", "\r\n"),
        ("\nelement", "\n\nelement"),
        ("end_header", "element face 0\nproperty list uchar int vertex_indices\nend_header"),
        ("end_header", "element camera 0\nend_header"),
    ],
)
def test_comments_and_empty_elements_are_tolerated(ply, old, new):
    np.testing.assert_array_equal(
        read_ply_elements(ply(HEADER.replace(old, new)))["vertex"], RECORDS
    )


def test_several_elements_are_read(ply):
    header = HEADER.replace("end_header", "element more 2\nproperty short s\nend_header")
    elements = read_ply_elements(ply(header, RECORDS.tobytes() + np.int16([-5, 9]).tobytes()))
    np.testing.assert_array_equal(elements["vertex"], RECORDS)
    assert elements["more"]["s"].tolist() == [-5, 9]


def test_an_element_without_records_is_empty(ply):
    elements = read_ply_elements(ply(HEADER.replace("vertex 3", "vertex 0"), b""))
    assert len(elements["vertex"]) == 0


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("", "not a ply"),
        ("PLY\n", "not a ply"),
        ("solid cube\nfacet\n", "not a ply"),
        ("ply", "not a ply"),
        ("ply\n", "no end_header"),
        ("ply\nend_header\n", "no format line"),
        (HEADER[:60], "no end_header"),
        (HEADER.replace("binary_little_endian", "ascii"), "could not convert"),
        (HEADER.replace("little_endian 1.0", "little_endian 2.0"), "format"),
        (HEADER.replace("format", "fromat"), "fromat"),
        (HEADER.replace("vertex 3", "vertex -3"), "count '-3'"),
        (HEADER.replace("vertex 3", "vertex 3.0"), "count '3.0'"),
        (HEADER.replace("vertex 3", "vertex " + "9" * 5000), "no usable number"),
        (HEADER.replace("vertex 3", "vertex"), "not understood"),
        (HEADER.replace("float x", "half x"), "types are"),
        (HEADER.replace("float x", "list uchar int x"), "list properties"),
        (HEADER.replace("uchar label", "float x"), "'x' twice"),
        (HEADER.replace("end_header", "element vertex 1\nend_header"), "'vertex' twice"),
        (HEADER.replace("element vertex 3\n", ""), "not understood"),
        (HEADER.replace("end_header", "surprise\nend_header"), "surprise"),
    ],
)
def test_bad_headers_are_refused_with_file_and_reason(ply, header, reason):
    with pytest.raises(BundleError, match=rf"file\.ply: .*{reason}"):
        read_ply_elements(ply(header))


def test_text_is_read(ply):
    header = HEADER.replace("binary_little_endian", "ascii")
    rows = [" ".join(repr(value) for value in row) for row in RECORDS.tolist()]
    text = "\n".join(rows).encode()
    for data in (text, text + b"\n", text.replace(b"\n", b" \r\n\r\n")):
        np.testing.assert_array_equal(read_ply_elements(ply(header, data))["vertex"], RECORDS)
    short = "\n".join(rows[:2]).encode()
    for data in (short, short + b" " * 100, text + b"\n1 2 3", text.replace(b" ", b"  9 ", 1)):
        with pytest.raises(BundleError, match=r"file\.ply"):
            read_ply_elements(ply(header, data))


def test_elements_with_lists_after_the_vertices_are_left_out(ply):
    header = HEADER.replace(
        "end_header", "element face 1\nproperty list uchar int vertex_indices\nend_header"
    )
    file = ply(header, RECORDS.tobytes() + bytes([3, *[0] * 12]))
    notes: list[str] = []
    np.testing.assert_array_equal(read_ply_elements(file, notes)["vertex"], RECORDS)
    assert ["'face' has list properties" in sentence for sentence in notes] == [True]
    with pytest.raises(BundleError, match="'face' has list properties"):
        read_ply_elements(file)


def test_an_endless_header_is_refused(ply):
    with pytest.raises(BundleError, match="no end_header"):
        read_ply_header(ply("ply\n" + "comment x\n" * (MAX_HEADER_BYTES // 8)))


@pytest.mark.parametrize("cut", [1, 13, 38])
def test_a_truncated_file_is_refused_with_both_sizes(ply, cut):
    data = RECORDS.tobytes()[:-cut]
    sizes = rf"needs {len(HEADER) + 39} bytes, the file has {len(HEADER) + 39 - cut}"
    with pytest.raises(BundleError, match=rf"truncated: .*3 vertex.*{sizes}"):
        read_ply_elements(ply(data=data))


def test_trailing_data_is_refused(ply):
    with pytest.raises(BundleError, match="longer than its header says"):
        read_ply_elements(ply(data=RECORDS.tobytes() + b"\0"))


def test_an_absurd_count_is_refused_as_truncated(ply):
    with pytest.raises(BundleError, match="truncated"):
        read_ply_elements(ply(HEADER.replace("vertex 3", "vertex 999999999999999")))


@pytest.mark.parametrize("kind", ["property float p{}", "element e{} 0"])
def test_a_header_with_too_many_lines_is_refused(ply, kind):
    lines = "\n".join(kind.format(i) for i in range(20_000))
    start = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    with pytest.raises(BundleError, match=f"more than {MAX_HEADER_LINES} elements and properties"):
        read_ply_header(ply(f"{start}{lines}\nend_header\n", b""))


def test_the_maximum_number_of_properties_is_read(ply):
    names = [f"p{i}" for i in range(MAX_HEADER_LINES - 2)]
    lines = "\n".join(f"property uchar {name}" for name in names)
    start = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    found = read_ply_header(ply(f"{start}{lines}\nend_header\n", b""))
    assert list(found.elements["vertex"].properties) == names


def test_messages_truncate_long_lines(ply):
    with pytest.raises(BundleError) as caught:
        read_ply_header(
            ply("ply\nformat binary_little_endian 1.0\n" + "x" * 100_000 + "\nend_header\n")
        )
    assert len(str(caught.value)) < 1000


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(BundleError, match=r"nothing\.ply: cannot be read: No such file"):
        read_ply_header(tmp_path / "nothing.ply")
