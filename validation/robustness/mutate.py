"""Mutations of a file: bits, ranges, numbers and words. The same random generator gives the same mutation."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Sequence

WORDS = (
    *(b"nan", b"inf", b"-inf", b"NaN(ind)", b"nan(", b"1e999", b"-0", b"0", b"1e-320", b"18446744073709551616"),
    *(
        b"9" * 400,
        b"1" * 5000,
        b"-1",
        b"0x1p-1074",
        b"true",
        b"null",
        b"[]",
        b"{}",
        b'""',
        b"[[]]",
        b"1_000",
        b"\xff\xfe",
    ),
    *(b"[" * 5000, b"{" * 3000, b'{"a":' * 2000, b"\x00", b"\xe2\x80\xae", b"\xed\xb2\x80", b"\x1b[31m", b"##[error]"),
    *(b"::error::", b"[/red]", b"#", b",", b"\n", b"\r", b'"', b"'", b"=", b"../../x", b"2147483648", b"4294967295"),
)
INTEGERS = (0, 1, 2, 127, 128, 255, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
XML_WORDS = (
    *(
        b"",
        b"&amp;",
        b"&#0;",
        b"$",
        b"$res",
        b"$" * 3000,
        b"1000000",
        b"1e30",
        b"nan",
        b"inf",
        b"-1",
        b"0",
        b"1, nan, 0",
    ),
    *(b"2147483647", b"4294967295", b"bk7", b"../x", b"/dev/zero", b"mutated.xml", b"plugins", b"x" * 5000),
)
XML_ELEMENTS = (
    *(
        b'<bsdf type="twosided">%s</bsdf>',
        b'<shape type="instance">%s</shape>',
        b"<a>%s</a>",
        b"<!-- %s -->",
        b"<![CDATA[%s",
    ),
    *(b'<include filename="mutated.xml"/>%s', b'<default name="res" value="99999"/>%s', b'<path value="meshes"/>%s'),
    *(b'<ref id="glass"/>%s', b'<bsdf type="mask" id="glass"><ref id="glass"/></bsdf>%s', b"<!DOCTYPE a>%s"),
)
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
TOKEN = re.compile(rb"[A-Za-z_][\w.]*|\"[^\"\n]*\"")

ATTRIBUTE = re.compile(rb'(?<==")[^"]*(?=")')
ELEMENT = re.compile(rb"<[a-z]")


def mutated(data: bytes, rng: random.Random, head: int | None = None) -> bytes:
    """`data` after one to four mutations; with `head`, three of four are in so many first bytes."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        near = len(data) if head is None or rng.random() < 0.25 else min(head, len(data))
        data = rng.choice(MUTATIONS)(data, rng, near)
    return data


def mutated_xml(data: bytes, rng: random.Random) -> bytes:
    """`data` after one to four mutations that leave most of it XML: of the values of attributes, and of elements."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if rng.random() < 0.8:
            data = _replace(ATTRIBUTE, XML_WORDS)(data, rng, len(data))
        else:
            begin, end = rng.choice(XML_ELEMENTS).split(b"%s")
            at, count = (
                rng.choice([0, *(found.start() for found in ELEMENT.finditer(data))]),
                rng.choice((1, 2, 40, 20_000)),
            )
            data = data[:at] + begin * count + end * count + data[at:]
    return data


def _flip(data: bytes, rng: random.Random, near: int) -> bytes:
    if not near:
        return data
    changed = bytearray(data)
    changed[rng.randrange(near)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _byte(data: bytes, rng: random.Random, near: int) -> bytes:
    at = rng.randrange(near + 1)
    return data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :]


def _integer(data: bytes, rng: random.Random, near: int) -> bytes:
    size = rng.choice((2, 4, 8))
    at = rng.randrange(near + 1)
    return data[:at] + (rng.choice(INTEGERS) % 256**size).to_bytes(size, "little") + data[at + size :]


def _range(rng: random.Random, near: int) -> tuple[int, int]:
    start = rng.randrange(near + 1)
    return start, min(near, start + int(rng.expovariate(1 / 12)) + 1)


def _remove(data: bytes, rng: random.Random, near: int) -> bytes:
    start, end = _range(rng, near)
    return data[:start] + data[end:]


def _repeat(data: bytes, rng: random.Random, near: int) -> bytes:
    start, end = _range(rng, near)
    return data[:end] + data[start:end] * rng.choice((1, 2, 50)) + data[end:]


def _cut(data: bytes, rng: random.Random, near: int) -> bytes:
    return data[: rng.randrange(near + 1)]


def _insert(data: bytes, rng: random.Random, near: int) -> bytes:
    at = rng.randrange(near + 1)
    return data[:at] + rng.choice(WORDS) + data[at:]


def _replace(
    pattern: re.Pattern[bytes], words: Sequence[bytes] = WORDS
) -> Callable[[bytes, random.Random, int], bytes]:
    def replace(data: bytes, rng: random.Random, near: int) -> bytes:
        found = list(pattern.finditer(data, 0, near))
        if not found:
            return _insert(data, rng, near)
        one, other = rng.choice(found), rng.choice(found)[0]
        return data[: one.start()] + (rng.choice(words) if rng.random() < 0.6 else other) + data[one.end() :]

    return replace


def _line(data: bytes, rng: random.Random, near: int) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i : i + rng.randrange(2)] = [lines[j]] * rng.randrange(2)
    return b"\n".join(lines)


MUTATIONS = (_flip, _byte, _integer, _remove, _repeat, _cut, _insert, _replace(NUMBER), _replace(TOKEN), _line)
