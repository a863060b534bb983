"""Folders of certificates, good ones and others."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from hal.apps.keys import main
from hal.keys import LIST, revoke


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
            _expire(copy, home)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HAL_KEYS", str(home))
        known = (home / LIST).read_text()
        (root / "revoking host" / LIST).write_text(revoke("anna").read_text())
        (home / LIST).write_text(known)


def _expire(file: Path, authority: Path) -> None:
    """Let a certificate have ended yesterday."""
    asked = ["openssl", "x509", "-x509toreq", "-in", file, "-key", file, "-copy_extensions", "copyall"]
    request = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    signed = ["-CA", authority / "authority.crt", "-CAkey", authority / "authority.key", "-set_serial", "7"]
    command = ["openssl", "x509", "-req", *signed, "-days", "-1", "-copy_extensions", "copyall"]
    old = subprocess.run(command, input=request, capture_output=True, text=True, check=True).stdout
    key, _, rest = file.read_text().partition("-----BEGIN CERTIFICATE-----")
    file.write_text(key + old + rest[rest.index("-----BEGIN") :])
