"""Certificates of the tests, each its own authority, by the program `openssl`."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

from mi_refract.cluster.local import PEM
from mi_refract.cluster.tls import Tls


def authority(folder: Path) -> Path:
    """`cert.pem`, which is its own authority, and `key.pem` in a new folder; the test is skipped without openssl."""
    folder.mkdir()
    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=test", "-keyout", "key.pem", at=folder)
    return folder


def openssl(*words: str, at: Path) -> None:
    """Run the program in a folder, where what it makes of certificates is `cert.pem`."""
    if (program := shutil.which("openssl")) is None:
        pytest.skip("needs the program openssl, which makes certificates")
    out = ("-out", "cert.pem") if words[0] == "req" else ()
    subprocess.run([program, *words, *out], cwd=at, check=True, capture_output=True)


def tls_files(pem: Mapping[str, str], folder: Path) -> Tls:
    """Files of the authority, certificate and key whose texts Dask's `Security` has under these names."""
    paths = [folder / f"{name}.pem" for name in PEM]
    for path in paths:
        path.write_text(pem[path.stem])
    return Tls(*paths)
