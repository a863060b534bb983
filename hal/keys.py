"""Certificates: who may connect from another computer, and which computers may be served from.

One authority, on one computer, makes a certificate for each *host* (a computer that serves: ``hal serve``, a policy's
server, the console) and for each *person* (who connects). Both ends show theirs, and neither talks to one that is not
of its authority, has the wrong role, has expired or was revoked. ``hal keys`` makes them with the program ``openssl``,
which is wherever there are certificates; using them needs the standard library alone.

A folder (:func:`keys_folder`) has ``ROLE-NAME.pem`` files: private key, certificate, certificate of the authority. That
of the authority's computer has its key, too, and :data:`LIST`, every certificate that was made and whether it is
revoked. Hosts read a copy of that list.
"""

from __future__ import annotations

import contextlib
import getpass
import ipaddress
import os
import re
import secrets
import socket
import ssl
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .errors import CommandError, ConnectionLost, DriverMissing, NotSupported

VIEWER = "viewer"
"""Role of those who may see states and pictures, and take nothing."""
ROLES = {"host": "serverAuth", "person": "clientAuth", VIEWER: "clientAuth"}
"""Role -> what its certificate may be used for, which TLS checks. A viewer's has the role in its subject, too."""
DAYS = 365
"""Life of a certificate, days."""
LIST = "certificates.txt"
HANDSHAKE_LIMIT = 2.0
"""Longest time that a handshake may take in all, s."""
_AUTHORITY_DAYS = 3650
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}", re.ASCII)
_PEM = re.compile(r"-----BEGIN CERTIFICATE-----.*?-----END CERTIFICATE-----\n", re.DOTALL)
_DRAIN = 0.5
"""Time for the other end to read why it is refused, s."""

# Making.


class Certificate(NamedTuple):
    """A line of the list."""

    serial: str
    """In hexadecimal, as Python's ``ssl`` has it."""
    role: str
    name: str
    until: str
    """Last day, UTC."""
    revoked: bool


def keys_folder() -> Path:
    """Return ``$HAL_KEYS``, by default ``$XDG_CONFIG_HOME/robot-hal/keys``, which is under ``~/.config``."""
    root = os.environ.get("XDG_CONFIG_HOME") or os.path.join(os.path.expanduser("~"), ".config")
    return Path(os.environ.get("HAL_KEYS") or os.path.join(root, "robot-hal", "keys"))


def make_key(role: str, name: str, addresses: Sequence[str] = (), days: int = DAYS) -> Path:
    """Make a certificate and its key, before that an authority if there is none; return the file.

    Args:
        role: A key of :data:`ROLES`.
        name: Of the computer or the person.
        addresses: Further names and addresses at which a host is reached; its name and ``NAME.local`` are known.
        days: How long it is valid.

    Raises:
        CommandError: A name or a number that cannot be (code ``bad_name``, ``bad_days``), or the authority is that of
            another computer (``no_authority``).
        DriverMissing: The program openssl is missing, or older than 3.0.
    """
    for word in (name, *addresses):
        if not _NAME.fullmatch(word) and not _is_address(word):
            raise CommandError(f"{word!r} is no name: letters, digits, dots and hyphens", code="bad_name")
    if not 0 < days <= _AUTHORITY_DAYS:
        raise CommandError(f"--days must be from 1 to {_AUTHORITY_DAYS}, not {days}", code="bad_days")
    folder = keys_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.chmod(0o700)
    authority, key = folder / "authority.crt", folder / "authority.key"
    if not key.exists():
        if there := [file.name for file in (*sorted(folder.glob("*.pem")), folder / LIST) if file.exists()]:
            text = f"{folder} has {', '.join(there)}, but no {key.name}: do this on the computer that made them"
            raise CommandError(f"{text}, or name an empty folder in HAL_KEYS for a new authority", code="no_authority")
        made = _make(f"robot-hal of {_own_name('person')}", _AUTHORITY_DAYS, "CA:TRUE,pathlen:0", "keyCertSign")
        _write(authority, "".join(_PEM.findall(made)))
        _write(key, _PEM.sub("", made))
    serial = f"{secrets.randbits(120) | 1 << 120:032X}"
    more = ["-CA", str(authority), "-CAkey", str(key), "-set_serial", f"0x{serial}"]
    more += ["-addext", f"extendedKeyUsage={ROLES[role]}"]
    if role == "host":
        names = [name, f"{name}.local", *addresses]
        kinds = ",".join(f"{'IP' if _is_address(one) else 'DNS'}:{one}" for one in dict.fromkeys(names))
        more += ["-addext", f"subjectAltName={kinds}"]
    made = _make(f"{name}/OU={VIEWER}" if role == VIEWER else name, days, "CA:FALSE", "digitalSignature", *more)
    until = time.strftime("%Y-%m-%d", time.gmtime(time.time() + 86400 * days))
    file = folder / f"{role}-{name}.pem"
    _write(file, made + authority.read_text())
    _write_list([*read_list(), Certificate(serial, role, name, until, False)])
    return file


def _make(name: str, days: int, constraint: str, usage: str, *more: str) -> str:
    """Return a new private key and its certificate, as text; signed by itself unless ``more`` says by what."""
    kind = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]  # P-256: browsers take no Ed25519
    extensions = ["-addext", f"basicConstraints=critical,{constraint}", "-addext", f"keyUsage=critical,{usage}"]
    command = ["openssl", "req", "-x509", "-config", os.devnull, "-subj", f"/CN={name}", "-days", str(days), *kind]
    try:
        made = subprocess.run([*command, *extensions, *more, "-keyout", "-"], capture_output=True, text=True)
    except FileNotFoundError:
        text = "the program openssl makes the certificates, and is not installed: sudo apt install openssl"
        raise DriverMissing(text, name="openssl") from None
    if made.returncode:
        text = f"openssl, which must be of version 3.0 or later, made no certificate: {made.stderr.strip()}"
        raise DriverMissing(text, name="openssl")
    return made.stdout


def _write(file: Path, text: str) -> None:
    """Write a file that only its owner reads; nobody sees a half of it, or it with other permissions."""
    unfinished = file.with_suffix(".tmp")
    unfinished.unlink(missing_ok=True)
    with open(os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
        out.write(text)
    os.replace(unfinished, file)


def _is_address(word: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(word))
    return False


def read_list(folder: Path | None = None) -> list[Certificate]:
    """Return the certificates that were made, as far as this folder has a list; by default :func:`keys_folder`.

    Raises:
        CommandError: The list cannot be read (code ``bad_key_list``).
    """
    file, found = (folder or keys_folder()) / LIST, []
    try:
        lines = file.read_text().splitlines()
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise CommandError(f"{file} cannot be read: {error}", code="bad_key_list") from error
    for line in lines:
        words = line.split()
        if len(words) not in (4, 5) or words[4:] not in ([], ["revoked"]):
            raise CommandError(f"{file} has a line that is none of hal keys: {line!r}", code="bad_key_list")
        serial, role, name, until = words[:4]
        found.append(Certificate(serial, role, name, until, len(words) == 5))
    return found


def _write_list(certificates: Sequence[Certificate]) -> None:
    lines = (" ".join([*line[:4], *["revoked"] * line.revoked]) + "\n" for line in certificates)
    _write(keys_folder() / LIST, "".join(lines))


def revoke(name: str) -> Path:
    """Revoke every certificate that was made for a name so far; return the list, which the hosts need, too.

    Raises:
        CommandError: There is none (code ``unknown_name``).
    """
    known = read_list()
    if all(line.name != name for line in known):
        names = ", ".join(dict.fromkeys(line.name for line in known)) or "none"
        raise CommandError(f"{keys_folder() / LIST} has no certificate of {name!r}, but: {names}", code="unknown_name")
    _write_list([line._replace(revoked=line.revoked or line.name == name) for line in known])
    return keys_folder() / LIST


# Using.


def needs_keys(address: str) -> bool:
    """Whether connections to an address are authenticated and encrypted: all but this computer's to itself."""
    return address not in ("127.0.0.1", "::1", "localhost")


def find_key(role: str) -> Path:
    """Return the file of this computer's certificate, or of this user's.

    Raises:
        NotSupported: There is none (code ``no_certificates``), or several, none of which has the name of this computer
            or user (``many_certificates``), or others can read it (``keys_readable``).
    """
    folder = keys_folder()
    if role == "person" and not any(folder.glob("person-*.pem")) and any(folder.glob(f"{VIEWER}-*.pem")):
        role = VIEWER
    found, own = sorted(folder.glob(f"{role}-*.pem")), folder / f"{role}-{_own_name(role)}.pem"
    if not found:
        make = "--host NAME" if role == "host" else "--person NAME"
        text = (
            f"there is no certificate of a {role} in {folder}: `hal keys make {make}`, on the computer that makes them"
        )
        raise NotSupported(f"{text}, and copy it here", code="no_certificates")
    if len(found) > 1 and own not in found:
        names = ", ".join(file.name for file in found)
        text = f"{folder} has {names}: name a folder with one of them in HAL_KEYS"
        raise NotSupported(text, code="many_certificates")
    file = own if own in found else found[0]
    if file.stat().st_mode & 0o077:
        raise NotSupported(f"others can read {file}, a private key: chmod 600 {file}", code="keys_readable")
    return file


def _own_name(role: str) -> str:
    if role == "host":
        return socket.gethostname().partition(".")[0]
    with contextlib.suppress(KeyError, OSError):  # a user without a name, as in some containers
        return getpass.getuser()
    return ""


class Credentials:
    """This end's certificate, and what it demands of the other end. A ``host`` listens, a ``person`` connects.

    Raises:
        NotSupported: There is no usable certificate here; as :func:`find_key`, or it is damaged (``bad_certificate``).
    """

    def __init__(self, role: str) -> None:
        self.file = find_key(role)
        self._host = role == "host"
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if self._host else ssl.PROTOCOL_TLS_CLIENT)
        """TLS 1.3; the other end must have a certificate of the same authority and of the other role."""
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.context.verify_mode = ssl.CERT_REQUIRED
        try:
            self.context.load_cert_chain(self.file)
            self.context.load_verify_locations(cadata=_PEM.findall(self.file.read_text())[-1])
        except (OSError, ValueError, IndexError) as error:
            raise NotSupported(f"{self.file} is damaged, make it again: {error}", code="bad_certificate") from error
        if self._host:
            self.context.num_tickets = 0  # every connection shows its certificate

    def wrap(self, sock: socket.socket, name: str = "") -> ssl.SSLSocket:
        """Return a connection with TLS on top, for :meth:`shake`; ``name`` is the host's, whose certificate has it."""
        sock.settimeout(HANDSHAKE_LIMIT)  # for the whole handshake
        server = None if self._host else name
        return self.context.wrap_socket(sock, self._host, do_handshake_on_connect=False, server_hostname=server)

    def shake(self, secured: ssl.SSLSocket, at: str) -> None:
        """Make the handshake, within :data:`HANDSHAKE_LIMIT` s; ``at`` is the other end, for messages.

        A person learns of the host's refusal with the first bytes that it reads.

        Raises:
            ConnectionLost: The other end is refused, or refuses; its connection is closed (see :meth:`explain`).
        """
        try:
            secured.do_handshake()
        except OSError as error:
            hang_up(secured)
            raise self.explain(error, at) from error

    def check(self, certificate: Mapping[str, Any], viewers: bool = False) -> str:
        """Return the name in the other end's certificate, which a handshake accepted.

        Raises:
            ConnectionLost: It was revoked (code ``certificate_revoked``), has expired (``certificate_expired``), or is
                that of a viewer (``certificate_wrong_role``), unless ``viewers`` are welcome.
        """
        name: str = next(value for part in certificate["subject"] for key, value in part if key == "commonName")
        if any(line.revoked and line.serial == certificate["serialNumber"] for line in read_list(self.file.parent)):
            text = f"the certificate of {name} is revoked: {_MAKE[not self._host]} makes a new one"
            raise ConnectionLost(text, code="certificate_revoked")
        if is_viewer(certificate) and not viewers:
            raise ConnectionLost(f"{name} may only watch arms and cameras", code="certificate_wrong_role")
        if time.time() > ssl.cert_time_to_seconds(certificate["notAfter"]):
            text = _EXPIRED.format(f"the certificate of {name}", _MAKE[not self._host])
            raise ConnectionLost(text, code=_THEIRS[10][0])
        return name

    def explain(self, error: BaseException, at: str) -> ConnectionLost:
        """Return what a failure of TLS means, with the remedy.

        Its code is ``certificate_`` and ``expired``, ``too_new``, ``foreign``, ``wrong_role``, ``wrong_name`` or
        ``missing``, whichever end's it is; else ``no_tls``.
        """
        reason = getattr(error, "reason", None) or str(error)
        if isinstance(error, ssl.SSLCertVerificationError):
            other = ("certificate_foreign", "{} is refused: " + error.verify_message)
            code, text = _THEIRS.get(error.verify_code, other)
            return ConnectionLost(text.format(f"the certificate of {at}", _MAKE[not self._host]), code=code)
        for end, code, text in _OURS:
            if reason.endswith(end):
                return ConnectionLost(f"{at} refuses: {text.format(self.file, _MAKE[self._host])}", code=code)
        if reason == "PEER_DID_NOT_RETURN_A_CERTIFICATE":
            text = f"{at} shows no certificate: `hal keys make --person NAME`"
            return ConnectionLost(text, code="certificate_missing")
        text = f"no encrypted connection to {at} ({reason}): is it `hal serve`, with certificates?"
        return ConnectionLost(text, code="no_tls")


def is_viewer(certificate: Mapping[str, Any]) -> bool:
    """Whether a certificate, which a handshake accepted, is that of a viewer."""
    return any(("organizationalUnitName", VIEWER) in part for part in certificate.get("subject", ()))


def find_credentials(role: str) -> Credentials | None:
    """Return the credentials of a role; None if there is no certificate. Raises as :class:`Credentials` otherwise."""
    try:
        return Credentials(role)
    except NotSupported as error:
        if error.code != "no_certificates":
            raise
        return None


def hang_up(sock: socket.socket) -> None:
    """Close a connection, after its other end has read what it was sent last, or :data:`_DRAIN` s."""
    end = time.monotonic() + _DRAIN
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_WR)  # of TLS, too: what comes now is thrown away unread
        while (left := end - time.monotonic()) > 0.0:
            sock.settimeout(left)
            if not sock.recv(1 << 14):
                break
    sock.close()


_MAKE = ("`hal keys make --person NAME`", "`hal keys make --host NAME ADDRESS`")
"""What makes the certificate of a person, and of a host."""
_EXPIRED = "{} has expired: {} makes a new one, to be copied there (or is a clock wrong? `date`)"
_FOREIGN = "{} is not from the authority of this end's: make both with `hal keys make` on one computer"
_ROLE = "{} is for the other end: a host needs one of `hal keys make --host`, a program one of `--person`"
_NAMES = "{} is for other names or addresses: `hal keys make --host NAME ADDRESS`, with the one that the rig has"
_THEIRS = {  # OpenSSL's numbers, X509_V_ERR_...
    9: ("certificate_too_new", "{} is not valid yet: compare the clocks of the two computers (`date`)"),
    10: ("certificate_expired", _EXPIRED),
    **dict.fromkeys((18, 19, 20, 21), ("certificate_foreign", _FOREIGN)),
    26: ("certificate_wrong_role", _ROLE),
    **dict.fromkeys((62, 64), ("certificate_wrong_name", _NAMES)),
}
_OURS = (  # how the alerts of the other end, which name nothing, end
    ("CERTIFICATE_EXPIRED", "certificate_expired", _EXPIRED),
    ("UNKNOWN_CA", "certificate_foreign", _FOREIGN),
    ("UNSUPPORTED_CERTIFICATE", "certificate_wrong_role", _ROLE),
    ("CERTIFICATE_REQUIRED", "certificate_missing", "{} is missing"),
    ("BAD_CERTIFICATE", "certificate_wrong_name", "{} is not accepted, for its names or its form"),
)
