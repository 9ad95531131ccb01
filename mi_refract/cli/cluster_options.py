"""The options by which a command has other processes work: on a Dask cluster, or on this machine.

`--scheduler` and `--workers` are each command's own, as their help says what is done there; the rest is the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mi_refract.cluster.connection import Elsewhere
from mi_refract.cluster.tls import Tls

TlsCaFile = Annotated[
    Path | None, typer.Option("--tls-ca-file", metavar="FILE", help="For tls://…: the authority, PEM.")
]
TlsCert = Annotated[Path | None, typer.Option("--tls-cert", metavar="FILE", help="For tls://…: our certificate, PEM.")]
TlsKey = Annotated[Path | None, typer.Option("--tls-key", metavar="FILE", help="For tls://…: our key, PEM.")]


def elsewhere(
    scheduler: str | None, workers: int | None, ca_file: Path | None, cert: Path | None, key: Path | None
) -> Elsewhere:
    """What the options say; `check` of it is left to the caller."""
    return Elsewhere(scheduler, workers, Tls(ca_file, cert, key))
