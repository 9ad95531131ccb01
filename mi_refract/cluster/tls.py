"""The files of TLS, which are tried before a connection is: what OpenSSL says of them does not name the file."""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ENCRYPTED = ("tls://", "wss://")  # addresses
ACCEPTED = "--tls-ca-file, --tls-cert, --tls-key: accepted with --scheduler tls://HOST:PORT"
_OPTIONS = ("--tls-ca-file", "--tls-cert", "--tls-key")
_PEM = "accepted: a file in PEM format"


@dataclass(frozen=True)
class Tls:
    """Files in PEM format for a `tls://` scheduler; None: as Dask's own configuration says."""

    ca_file: Path | None = None
    cert: Path | None = None
    key: Path | None = None

    @property
    def given(self) -> bool:
        """Whether any is given."""
        return any((self.ca_file, self.cert, self.key))

    def security(self, address: str) -> Any:
        """A `distributed.Security` for the scheduler at an address.

        ValueError or FileNotFoundError, one line, where no connection can be made with these files.
        """
        from distributed.security import Security

        encrypted = address.startswith(ENCRYPTED)
        if self.given and not encrypted:
            raise ValueError(f"--scheduler {address}: is not encrypted; {ACCEPTED}")
        for option, path in zip(_OPTIONS, (self.ca_file, self.cert, self.key), strict=True):
            if path is not None:
                _require_readable(option, str(path))
        files = {"tls_ca_file": self.ca_file, "tls_client_cert": self.cert, "tls_client_key": self.key}
        named = {name: str(path) for name, path in files.items() if path is not None}
        security = Security(**named, require_encryption=True) if named else Security()
        if encrypted:
            _try(address, security.get_tls_config_for_role("client"))
        return security


NO_TLS = Tls()


def _try(address: str, files: Mapping[str, str | None]) -> None:
    ca_file, cert, key = files["ca_file"], files["cert"], files["key"] or files["cert"]
    if not ca_file or not cert or not key:
        raise ValueError(f"--scheduler {address}: no --tls-ca-file or no --tls-cert; accepted: both, and --tls-key")
    if any("\n" in each for each in (ca_file, cert, key)):
        return  # not a file: Dask's configuration holds its text
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    for option, file in zip(_OPTIONS, (ca_file, cert, key), strict=True):
        _require_readable(option, file)
        if option == "--tls-key":
            break
        try:
            context.load_verify_locations(cafile=file)
        except ssl.SSLError:
            raise ValueError(f"{option} {file}: holds no certificate; {_PEM}") from None
    try:
        context.load_cert_chain(cert, key, password=_refuse_password)
    except _PasswordError:
        raise ValueError(f"--tls-key {key}: is encrypted; accepted: a key without a password") from None
    except ssl.SSLError:
        raise ValueError(f"--tls-key {key}: does not hold the key of {cert}; {_PEM}") from None


def _require_readable(option: str, file: str) -> None:
    if not Path(file).is_file():
        raise FileNotFoundError(f"{option} {file}: no such file; {_PEM}")
    try:
        Path(file).read_bytes()
    except OSError as error:
        raise ValueError(f"{option} {file}: {error.strerror}; {_PEM}") from None


class _PasswordError(Exception):
    """A key asks for its password; OpenSSL would ask the terminal."""


def _refuse_password() -> str:
    raise _PasswordError
