"""The files of TLS: each that cannot be used is named, before a connection is tried."""

from __future__ import annotations

import os

import pytest
from support.certificates import authority, openssl

from mi_refract.cluster.tls import Tls

ADDRESS = "tls://h:1"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A certificate and its key; another key, and the first one with a password; a file that is neither."""
    folder = authority(tmp_path_factory.mktemp("tls") / "own")
    openssl("genrsa", "-out", "other.pem", "2048", at=folder)
    openssl("rsa", "-aes128", "-passout", "pass:x", "-in", "key.pem", "-out", "encrypted.pem", at=folder)
    (folder / "both.pem").write_text((folder / "cert.pem").read_text() + (folder / "key.pem").read_text())
    (folder / "text.pem").write_text("text")
    return folder


def tls(folder, *names):
    return Tls(*(None if name is None else folder / f"{name}.pem" for name in names))


@pytest.mark.parametrize("names", [("cert", "cert", "key"), ("cert", "both", None)])
def test_files_that_can_be_used(files, names):
    security = tls(files, *names).security(ADDRESS)
    assert security.require_encryption and security.get_connection_args("client")["ssl_context"]


@pytest.mark.parametrize(
    "names, message",
    [
        (("none", "cert", "key"), "--tls-ca-file {}/none.pem: no such file; accepted: a file in PEM format"),
        (("text", "cert", "key"), "--tls-ca-file {}/text.pem: holds no certificate; accepted: a file in PEM format"),
        (("cert", "key", "key"), "--tls-cert {}/key.pem: holds no certificate"),
        (("cert", "cert", "none"), "--tls-key {}/none.pem: no such file"),
        (("cert", "cert", "text"), "--tls-key {}/text.pem: does not hold the key of {}/cert.pem"),
        (("cert", "cert", "other"), "--tls-key {}/other.pem: does not hold the key of {}/cert.pem"),
        (("cert", "cert", None), "--tls-key {}/cert.pem: does not hold the key of {}/cert.pem"),
        (("cert", "cert", "encrypted"), "--tls-key {}/encrypted.pem: is encrypted; accepted: a key without a password"),
        (("cert", None, None), "--scheduler tls://h:1: no --tls-ca-file or no --tls-cert"),
    ],
)
def test_files_that_cannot(files, names, message):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        tls(files, *names).security(ADDRESS)
    assert str(caught.value).startswith(message.replace("{}", str(files))) and "\n" not in str(caught.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_a_file_that_may_not_be_read(files, tmp_path):
    key = tmp_path / "key.pem"
    key.touch(0)
    with pytest.raises(ValueError, match=r"key\.pem: Permission denied; accepted: a file in PEM format"):
        Tls(files / "cert.pem", files / "cert.pem", key).security(ADDRESS)


def test_files_of_dasks_configuration_count(files):
    import dask

    section = {"ca-file": "no.pem", "client.cert": str(files / "cert.pem"), "client.key": str(files / "key.pem")}
    with dask.config.set({f"distributed.comm.tls.{name}": value for name, value in section.items()}):
        assert tls(files, "cert").security(ADDRESS).tls_client_key == str(files / "key.pem")
        with pytest.raises(FileNotFoundError, match=r"--tls-ca-file no\.pem"):
            Tls().security(ADDRESS)
