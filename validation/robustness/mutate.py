"""Mutations of a file: bits, ranges, numbers and words. The same random generator gives the same mutation."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

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
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
TOKEN = re.compile(rb"[A-Za-z_][\w.]*|\"[^\"\n]*\"")


def mutated(data: bytes, rng: random.Random, head: int | None = None) -> bytes:
    """`data` after one to four mutations; with `head`, three of four are in so many first bytes."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        near = len(data) if head is None or rng.random() < 0.25 else min(head, len(data))
        data = rng.choice(MUTATIONS)(data, rng, near)
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


def _replace(pattern: re.Pattern[bytes]) -> Callable[[bytes, random.Random, int], bytes]:
    def replace(data: bytes, rng: random.Random, near: int) -> bytes:
        found = list(pattern.finditer(data, 0, near))
        if not found:
            return _insert(data, rng, near)
        one, other = rng.choice(found), rng.choice(found)[0]
        return data[: one.start()] + (rng.choice(WORDS) if rng.random() < 0.6 else other) + data[one.end() :]

    return replace


def _line(data: bytes, rng: random.Random, near: int) -> bytes:
    lines = data.split(b"\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[i : i + rng.randrange(2)] = [lines[j]] * rng.randrange(2)
    return b"\n".join(lines)


MUTATIONS = (_flip, _byte, _integer, _remove, _repeat, _cut, _insert, _replace(NUMBER), _replace(TOKEN), _line)
