"""Folders of certificates, good ones and others."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import pytest

from hal.apps.keys import main
from hal.keys import LIST, revoke

_CA = """
[ca]
default_ca = this
[this]
database = {folder}/index
new_certs_dir = {folder}
certificate = {folder}/authority.crt
private_key = {folder}/authority.key
rand_serial = yes
unique_subject = no
default_md = sha256
copy_extensions = copyall
policy = names
[names]
commonName = supplied
"""
"""Of the program openssl, whose other commands count the validity in days."""


def make_keys(root: Path, address: str) -> None:
    """Make a folder for each kind of host and of person, in ``root``; ``home`` and ``foreign`` are of authorities."""
    with pytest.MonkeyPatch.context() as patch:
        for folder in ("home", "foreign"):
            patch.setenv("HAL_KEYS", str(root / folder))
            hosts = ["--host", "arm-pc", address, "--host", "other", "10.0.0.7"]
            assert main(["make", *hosts, "--person", "anna", "--viewer", "tv"]) == 0
    home = root / "home"
    for folder, file, name in (
        ("person", home / "person-anna.pem", ""),
        ("viewer", home / "viewer-tv.pem", ""),
        ("host", home / "host-arm-pc.pem", ""),
        ("revoking host", home / "host-arm-pc.pem", ""),
        ("other host", home / "host-other.pem", ""),
        ("foreign host", root / "foreign" / "host-arm-pc.pem", ""),
        ("foreign person", root / "foreign" / "person-anna.pem", ""),
        ("host as person", home / "host-arm-pc.pem", "person-x.pem"),
        ("person as host", home / "person-anna.pem", "host-x.pem"),
        ("expired person", home / "person-anna.pem", ""),
        ("expired host", home / "host-arm-pc.pem", ""),
    ):
        (root / folder).mkdir()
        copy = root / folder / (name or file.name)
        copy.write_text(file.read_text())
        copy.chmod(0o600)
        if folder.startswith("expired"):
            end_validity(copy, home, -86400.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HAL_KEYS", str(home))
        known = (home / LIST).read_text()
        (root / "revoking host" / LIST).write_text(revoke("anna").read_text())
        (home / LIST).write_text(known)


def end_validity(file: Path, authority: Path, seconds: float) -> None:
    """Sign a certificate anew so that it ends in so many seconds, or has ended."""
    asked = ["openssl", "x509", "-x509toreq", "-in", file, "-key", file, "-copy_extensions", "copyall"]
    request = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    (authority / "index").touch()
    (authority / "ca.conf").write_text(_CA.format(folder=authority))
    until = time.strftime("%Y%m%d%H%M%SZ", time.gmtime(time.time() + seconds))
    dates = ["-startdate", "20200101000000Z", "-enddate", until]
    command = ["openssl", "ca", "-batch", "-notext", "-config", authority / "ca.conf", "-in", "/dev/stdin", *dates]
    signed = subprocess.run(command, input=request, capture_output=True, text=True, check=True).stdout
    key, _, rest = file.read_text().partition("-----BEGIN CERTIFICATE-----")
    file.write_text(key + signed + rest[rest.index("-----BEGIN") :])
