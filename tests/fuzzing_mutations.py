"""Changes for the fuzzer: of documents by structure and text, and of zip files."""

import io
import json
import os
import pickle
import random
import socket
import struct
import zipfile
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

LITERALS = (
    *(
        "NaN",
        "Infinity",
        "-Infinity",
        "1e999",
        "-1e999",
        "1e308",
        "1e-320",
        "-0.0",
        "0.1e1",
    ),
    *(
        "9" * 5000,
        "9" * 4000,
        "-" + "9" * 400,
        "9223372036854775808",
        "18446744073709551616",
        "1" + "0" * 300,
    ),
    *(
        r'"\ud800"',
        r'"a\udfff"',
        r'"\u0000"',
        r'"\u001b[31m"',
        r'"\n\n"',
        '"\u2028"',
        "'a'",
        "01",
        "+1",
        "0x10",
        "",
    ),
    *("[" * depth + "]" * depth for depth in (5, 70, 500, 990, 3000, 100_000)),
    *('{"a":' * depth + "1" + "}" * depth for depth in (70, 900, 20_000)),
    '{"a": 1, "a": 2}',
)
"""What may stand in a document as text, though no value of Python is written so."""
VALUES = (
    *(
        None,
        True,
        False,
        0,
        1,
        -1,
        2,
        2**31,
        2**53 + 1,
        2**63 - 1,
        1e308,
        -1e-308,
        0.5,
        "",
        "word",
        "x" * 300,
        "../x",
    ),
    *(
        "/etc/passwd",
        "a\0b",
        "a/b",
        "nan",
        "1",
        [],
        {},
        [None],
        [[]],
        [1, 2, 3],
        [[1, 2], 3],
        {"a": 1},
        {"mean": "x"},
    ),
    *(
        ["a"] * 100,
        "\n",
        "\u00e4",
        "$",
        "%",
        "\\",
        "<b>",
        "s3",
        "oracle",
        [{}],
        [[[[1]]]],
        {"": ""},
        "0" * 64,
    ),
)
FOREIGN = (
    b"",
    b"\xff\xfe\x00",
    b"PK\x03\x04",
    b"\x93NUMPY",
    b"null",
    b"[]",
    b"{}",
    b"0",
    b'""',
    b" " * 5000,
    b"\0" * 100,
)
HEADERS = (
    *(
        "'shape': (10000000000,)",
        "'shape': (100000, 100000, 100000)",
        "'shape': (-1,)",
        "'shape': (1e3,)",
        "'shape': 3",
    ),
    *(
        "'shape': (True,)",
        "'shape': (3)",
        "'shape': (3L,)",
        "'shape': ()",
        "'shape': (0, 999999999999999999)",
    ),
    *(
        "'shape': (" + "9" * 5000 + ",)",
        "'shape': (" + "1," * 40 + ")",
        "'shape': [3]",
        "'shape': (2, 2",
    ),
    *(
        f"'descr': '{kind}'"
        for kind in (
            "|O",
            "<U999999999",
            "|V8",
            "<f3",
            "<f8",
            "<i4",
            "<M8",
            "<M8[s]",
            "|S0",
            "|b1",
        )
    ),
    *(
        "'descr': [('a', '<f4')]",
        "'descr': '<f4,<f4'",
        "'descr': object",
        "'descr': ''",
        "'descr': '<U0'",
        "'descr': 3",
    ),
    *(
        "'fortran_order': True",
        "'fortran_order': 1",
        "'x': 1",
        "'shape': (3,",
        "(" * 3000,
        "-" * 9000,
        "'''",
        "\\",
        "\0",
    ),
    *(
        "__import__('os').abort()",
        "'shape': (0x10,)",
        "'shape': (3,), 'shape': (4,)",
        "[" * 300 + "]" * 300,
        "\t\x0c\n  a",
    ),
)
"""What may stand in the header of a .npy file."""


def json_change(draw: random.Random, content: bytes) -> bytes:
    """A document with another value, another text or other bytes."""
    if draw.random() < 0.25:
        return text_change(draw, content)
    document = json.loads(content)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        document = value_change(draw, document)
    text = json.dumps(document, indent=draw.choice((None, 2)))
    for _ in range(text.count('"@@raw"')):
        text = text.replace('"@@raw"', draw.choice(LITERALS), 1)
    return text.encode("utf-8", "surrogatepass")


def value_change(draw: random.Random, document: Any) -> Any:
    """One value gone, replaced, doubled, moved or made larger, anywhere in a document."""
    paths_in = list(_paths_in(document))
    if not paths_in:
        return deepcopy(draw.choice(VALUES))
    inner, key = draw.choice(paths_in)
    value, kind = inner[key], draw.randrange(8)
    if kind == 0:
        del inner[key]
    elif kind == 1:
        inner[key] = "@@raw"
    elif kind == 2 and isinstance(inner, dict):
        inner[draw.choice(("x", "", "a\0", "kind", "..", "é"))] = inner.pop(key)
    elif kind == 3:
        inner[key] = draw.choice(
            ([value], {"a": value}, str(value), [value, deepcopy(value)])
        )
    elif kind == 4 and isinstance(value, (int, float)):
        inner[key] = draw.choice(
            (-value, value * 1e30, value + 1, float(value), str(value))
        )
    elif kind == 5:
        other, run_dir = draw.choice(paths_in)
        inner[key] = json.loads(json.dumps(other[run_dir]))
    elif kind == 6 and isinstance(value, list):
        inner[key] = draw.choice(
            (value[:1], value[1:], deepcopy(value) + value, value[::-1], [*value, None])
        )
    else:
        inner[key] = deepcopy(
            draw.choice(VALUES)
        )  # of which later changes would else change all
    return document


def _paths_in(value: Any) -> Any:
    entries = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, entry in entries:
        yield value, key
        yield from _paths_in(entry)


def text_change(draw: random.Random, content: bytes) -> bytes:
    """Another encoding, a mark in front, more behind it, or other bytes."""
    text = content.decode()
    at = draw.randrange(len(text) + 1)
    return draw.choice(
        (
            lambda: b"\xef\xbb\xbf" + content,
            lambda: text.encode(
                draw.choice(("utf-16", "utf-16-le", "utf-32", "utf-7", "cp500"))
            ),
            lambda: (text[:at] + draw.choice(LITERALS) + text[at:]).encode(
                "utf-8", "surrogatepass"
            ),
            lambda: (text[:at] + "\ud83d" + text[at:]).encode("utf-8", "surrogatepass"),
            lambda: (
                content
                + draw.choice((content, b"}", b"\n\n", b"\0", b"// x", b" " * 100_000))
            ),
            lambda: byte_change(draw, content),
        )
    )()


def byte_change(draw: random.Random, content: bytes) -> bytes:
    """Bits flipped; bytes cut, inserted, repeated, or foreign."""
    at, to = sorted(draw.randrange(len(content) + 1) for _ in range(2))
    kind = draw.randrange(7)
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + content[to:]
    if kind == 2:
        return content[:at] + draw.randbytes(draw.choice((1, 4, 100))) + content[at:]
    if kind == 3:
        return content[:to] + content[at:]
    if kind == 4:
        foreign = (
            *FOREIGN,
            pickle.dumps({"a": 1}),
            draw.randbytes(500),
            b"PK\x03\x04" + draw.randbytes(200),
        )
        return draw.choice(foreign)
    changed = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 8)) if changed else 0):
        at = draw.randrange(len(changed))
        changed[at] = draw.choice(
            (changed[at] ^ (1 << draw.randrange(8)), 0, 255, draw.randrange(256))
        )
    return bytes(changed)


def lines_change(draw: random.Random, content: bytes) -> bytes:
    """A log of JSON lines with lines changed, gone, doubled or joined."""
    lines = content.split(b"\n")
    at, kind = draw.randrange(len(lines) - 1), draw.randrange(6)
    if kind == 0:
        return text_change(draw, content)
    if kind == 1:
        lines[at : at + 1] = []
    elif kind == 2:
        lines[at] = draw.choice(FOREIGN)
    elif kind == 3:
        lines[at : at + 2] = [b" ".join(lines[at : at + 2])]
    else:
        lines[at] = json_change(draw, lines[at]).replace(b"\n", b" ")
    return b"\n".join(lines)


def csv_change(draw: random.Random, content: bytes) -> bytes:
    """A table with cells, rows, columns, separators or bytes changed."""
    if draw.random() < 0.3:
        return text_change(draw, content)
    rows = [line.split(",") for line in content.decode().split("\n")]
    for _ in range(draw.choice((1, 1, 3))):
        row, kind = draw.randrange(len(rows) - 1), draw.randrange(6)
        if kind == 0:
            rows[row] = rows[row][: draw.randrange(len(rows[row]) + 1)]
        elif kind == 1:
            rows[row : row + 1] = draw.choice(
                ([], [rows[row]] * 2, [rows[row - 1]], [["#", "a"]], [[""]])
            )
        elif kind == 2:
            rows[0][draw.randrange(len(rows[0]))] = draw.choice(
                ("", "t", "1.0", "x" * 5000, "\0", '"', "é")
            )
        elif rows[row]:
            cells = (
                "",
                "nan",
                "inf",
                "-inf",
                "1e400",
                "1e308",
                "0x1",
                "1_0",
                "١",
                "text",
                '"',
                '"a\nb"',
                "\0",
                " 1 ",
            )
            cells += (
                "9" * 5000,
                "x" * 200_000,
                "1e-400",
                "-1e30",
                "True",
                "1,5",
                "1 2",
                "\r",
                "=1+1",
                "#",
            )
            rows[row][draw.randrange(len(rows[row]))] = draw.choice(cells)
    text = "\n".join(
        draw.choice((",", ",", ",", ";", "\t", " ")).join(row) for row in rows
    )
    return text.encode()


def npz_change(draw: random.Random, content: bytes) -> bytes:
    """A zip file with headers, members, its directory or its bytes changed."""
    kind = draw.randrange(10)
    if draw.random() < 0.01:
        return bomb(draw.choice((8, 600)))
    if kind < 3:
        return byte_change(draw, content)
    if kind < 5:
        return _fields(draw, content)
    with zipfile.ZipFile(io.BytesIO(content)) as zip_file:
        entries = [(name, zip_file.read(name)) for name in zip_file.namelist()]
    at = draw.randrange(len(entries))
    name, member = entries[at]
    if kind < 8:
        entries[at] = name, _header(draw, member)
    elif kind == 8:
        entries[at : at + 1] = draw.choice(
            (
                [],
                [(name, member)] * 2,
                [
                    (
                        draw.choice(
                            (
                                "a",
                                "../x.npy",
                                "\u2028.npy",
                                "x.npy.npy",
                                ".npy",
                                "a\n.npy",
                                "x" * 3000,
                            )
                        ),
                        member,
                    )
                ],
                [(name, byte_change(draw, member))],
                [(name, pickle.dumps(entries))],
                [(name, member + b"\0" * 8)],
                [(f"{k}.npy", member) for k in range(300)],
            )
        )
    method = draw.choice(
        (zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
    )
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as zip_file:
        for name, member in entries:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            zip_file.writestr(info, member)
    return packed.getvalue()


def _header(draw: random.Random, member: bytes) -> bytes:
    """A .npy file with another header before the same data."""
    length = struct.unpack("<H", member[8:10])[0]
    text, data, new = (
        member[10 : 10 + length].decode("latin1"),
        member[10 + length :],
        draw.choice(HEADERS),
    )
    key = new.partition(":")[0]
    start = text.find(key) if ":" in new else -1
    if start >= 0 and draw.random() < 0.8:
        end = (
            text.find(", '", start)
            if not key.startswith("'shape")
            else text.find("), ", start) + 1
        )
        text = text[:start] + new + text[end:]
    else:
        at = draw.randrange(len(text))
        text = text[:at] + new + text[at:]
    version, width = draw.choice(
        ((1, "<H"),) * 8 + ((2, "<I"), (3, "<I"), (0, "<H"), (9, "<H"))
    )
    declared = draw.choice((len(text),) * 6 + (0, 1, 65535, len(text) + 7))
    if width == "<I":
        declared = draw.choice((declared, declared, 2**32 - 1))
    return (
        b"\x93NUMPY"
        + bytes((version, 0))
        + struct.pack(width, declared % 2 ** (16 if width == "<H" else 32))
        + (text.encode("latin1", "replace") + data)
    )


def _fields(draw: random.Random, content: bytes) -> bytes:
    """A zip file with a field of a local header, of the directory or of its end set to
    an extreme.
    """
    changed = bytearray(content)
    marks = [(b"PK\x01\x02", 46), (b"PK\x03\x04", 30), (b"PK\x05\x06", 22)]
    for _ in range(draw.choice((1, 1, 2, 3))):
        mark, size = draw.choice(marks)
        paths_in = [
            at for at in range(len(content) - size) if content[at : at + 4] == mark
        ]
        paths_in = paths_in or [content.rfind(b"PK\x05\x06")]
        at, width = (
            draw.choice(paths_in) + draw.randrange(4, size - 3),
            draw.choice((1, 2, 4)),
        )
        value = draw.choice(
            (
                0,
                1,
                8,
                12,
                14,
                99,
                2**15,
                2**31 - 1,
                2**31,
                2**32 - 1,
                len(content),
                draw.randrange(2**32),
            )
        )
        changed[at : at + width] = (value % 256**width).to_bytes(width, "little")
    return bytes(changed)


@cache
def bomb(size: int) -> bytes:
    """A zip file with one array of so many MiB of zeros, of which it holds a
    thousandth.
    """
    packed, header = (
        io.BytesIO(),
        b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }\n" % (size << 20),
    )
    zip_file = zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with zip_file, zip_file.open("t.npy", "w") as entry:
        entry.write(b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header)
        for _ in range(size):
            entry.write(bytes(1 << 20))
    return packed.getvalue()


def put_special_file(draw: random.Random, path: Path) -> None:
    """Replace a file by something that is no regular file."""
    path.unlink()
    kind = draw.randrange(8)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.mkdir()
    elif kind == 2:
        run_dir = os.getcwd()
        os.chdir(path.parent)  # the name of a socket has at most 107 bytes
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
        os.chdir(run_dir)
    elif kind < 7:
        path.symlink_to(("/dev/zero", "/dev/null", path.name, "nowhere")[kind - 3])
