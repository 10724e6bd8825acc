"""A small authority: X.509 certificates for a server and its clients, and rules of what each may do.

Keys are of the curve P-256. Its folder:

ca.pem, ca.key          the authority; nobody but this folder needs the key
server.json5            Zenoh configuration of the server, with its key and the rules of all clients
clients/NAME.json5      Zenoh configuration of a client, with its key: all that its device needs
issued/NAME.pem         certificates of clients that the rules name
revoked/NAME.pem        those of clients that they do not name any more
"""

import base64
import fcntl
import ipaddress
import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.features.decode import DecodeLimits
from reloc.wire.keys import ANONYMOUS, CLIENT_SETTING, NAME_EXPECTED, Keys, is_name
from reloc.wire.query import MESSAGE_HEADROOM

# Who may come in is for the access rules to say, not for dates: a phone that is forgotten goes on working.
_VALID = timedelta(days=3650)
_CLOCKS_DIFFER = timedelta(days=1)  # a device that was just switched on may be behind


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes

    @classmethod
    def authority(cls) -> "Identity":
        """An authority, which signs the certificates of others and nothing else."""
        return _identity("featuredb authority", None)

    def server(self, name: str, hosts: tuple[str, ...]) -> "Identity":
        """A server's, signed by this authority; clients that connect to another host refuse it."""
        uses = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        names = x509.SubjectAlternativeName([_host(host) for host in hosts])
        return _identity(name, self, x509.ExtendedKeyUsage(uses), names)

    def client(self, name: str) -> "Identity":
        """A client's, signed by this authority; it cannot be a server's."""
        return _identity(name, self, x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]))


def _identity(name: str, signer: Identity | None, *uses: x509.ExtensionType) -> Identity:
    """A new key, and a certificate of it; without a signer that of an authority, which signs its own."""
    key = signing = ec.generate_private_key(ec.SECP256R1())
    issuer = own = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    if signer is not None:
        issuer = x509.load_pem_x509_certificate(signer.certificate).subject
        loaded = serialization.load_pem_private_key(signer.key, password=None)
        assert isinstance(loaded, ec.EllipticCurvePrivateKey)
        signing = loaded
    now, is_authority = datetime.now(UTC), signer is None
    signs = {"digital_signature": not is_authority, "key_cert_sign": is_authority, "crl_sign": is_authority}
    others = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    never = dict.fromkeys((*others, "encipher_only", "decipher_only"), False)
    builder = (
        x509.CertificateBuilder()
        .subject_name(own)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS_DIFFER)
        .not_valid_after(now + _VALID)
        .add_extension(x509.BasicConstraints(is_authority, 0 if is_authority else None), critical=True)
        .add_extension(x509.KeyUsage(**signs, **never), critical=True)
    )
    for extension in uses:
        builder = builder.add_extension(extension, critical=False)
    return Identity(
        certificate=builder.sign(signing, hashes.SHA256()).public_bytes(serialization.Encoding.PEM),
        key=key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        ),
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


DEFAULT_PORT = 7447  # Zenoh's own
_SERVER = "server"
_LOCALHOST = "localhost"
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_ENDPOINTS = "featuredb_endpoints"  # in the server's `metadata`: where clients connect
_CONNECT_TIMEOUT_MS = 5000
_HEAD = "// Written by `featuredb keys`. Holds a private key.\n"
_SERVER_HEAD = (
    _HEAD
    + "// Each client that comes or goes: access_control is written anew, comments go, the rest stays.\n"
)

Section = dict[str, Any]  # of a Zenoh configuration, or all of it

_KEYS = Keys(database="*")
_IN, _OUT = "ingress", "egress"
_ALL = [
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]


def access_control(server: str, clients: Iterable[str]) -> Section:
    """The section `access_control` of a server's Zenoh configuration: what no rule allows is dropped.

    By names in certificates: other servers may do all, each client may ask, and has live sessions of its own.
    """
    serve, common = _rule("serve", [_IN, _OUT], _ALL, [_KEYS.of("**")]), _rules_of_all()
    rules, policies = [serve, *common], [_policy(server, [serve])]
    for client in clients:
        own = _own(client)
        rules += own
        policies.append(_policy(client, [*common, *own]))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": name, "cert_common_names": [name]} for name in (server, *clients)],
        "policies": policies,
    }


def _rules_of_all() -> list[Section]:
    """What all clients may: ask a server about itself, find it, hear its events."""
    about = [_KEYS.of("status"), _KEYS.of("maps")]
    offered = [*about, _KEYS.localise("*"), _KEYS.localise("*", "*"), _KEYS.track("*", "*")]
    tokens, events = [_KEYS.server_token("*"), _KEYS.tile_token("*", "*")], [_KEYS.of("events")]
    return [
        _rule("ask", [_IN], ["query"], about),
        _rule("answer", [_OUT], ["reply"], about),
        _rule("offer", [_OUT], ["declare_queryable"], offered),
        _rule("look for servers", [_IN], ["liveliness_query", "declare_liveliness_subscriber"], tokens),
        _rule("advertise", [_OUT], ["liveliness_token"], tokens),
        _rule("subscribe to events", [_IN], ["declare_subscriber"], events),
        _rule("publish events", [_OUT], ["put"], events),
    ]


def _own(client: str) -> list[Section]:
    """Photos to localise, and live sessions, under the client's own name."""
    asked = [_KEYS.localise(client), _KEYS.localise(client, "*"), _KEYS.track(client, "*")]
    poses = [_KEYS.track(client, "*", leaf) for leaf in ("poses", "events")]
    frames, token = [_KEYS.track(client, "*", "frames")], [_KEYS.track(client, "*", "client")]
    return [
        _rule(f"{client}: ask", [_IN], ["query"], asked),
        _rule(f"{client}: answer", [_OUT], ["reply"], asked),
        _rule(f"{client}: subscribe to poses", [_IN], ["declare_subscriber"], poses),
        _rule(f"{client}: publish poses", [_OUT], ["put"], poses),
        _rule(f"{client}: send frames", [_IN], ["put"], frames),
        _rule(f"{client}: take frames", [_OUT], ["declare_subscriber"], frames),
        _rule(f"{client}: be alive", [_IN], ["liveliness_token"], token),
    ]


def _rule(name: str, flows: list[str], messages: list[str], keys: list[str]) -> Section:
    return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}


def _policy(subject: str, rules: list[Section]) -> Section:
    return {"rules": [rule["id"] for rule in rules], "subjects": [subject]}


class AuthorityError(FeatureDbError):
    """A folder that is no authority, or what one does not do."""


class Authority:
    """An authority in a folder; `create` makes one."""

    def __init__(self, folder: Path) -> None:
        """
        Raises:
            AuthorityError: there is none.
        """
        self.folder = folder
        self.server_config = folder / "server.json5"
        try:
            self._identity = Identity(
                certificate=(folder / "ca.pem").read_bytes(), key=(folder / "ca.key").read_bytes()
            )
        except OSError as error:
            raise AuthorityError(
                f"{folder}: expected an authority, found none ({error.strerror}); make it by `featuredb keys "
                f"init {folder}`"
            ) from error

    @classmethod
    def create(cls, folder: Path, hosts: tuple[str, ...] = (), port: int = DEFAULT_PORT) -> "Authority":
        """Make the folder, with the configuration of a server.

        Args:
            hosts: names and addresses by which clients reach the server, tried in this order. None: it
                listens on this machine only, as localhost.

        Raises:
            AuthorityError: the folder holds something already.
            InvalidValueError: no host, or no port.
        """
        for host in hosts:
            if not _HOST.fullmatch(host):
                raise InvalidValueError(f"host: expected a name or an address, found {host!r}")
        if not 0 < port < 65_536:
            raise InvalidValueError(f"port: expected 1..65535, found {port}")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise AuthorityError(
                f"{folder}: expected no such folder, or an empty one; nothing is overwritten"
            )
        identity = Identity.authority()
        server = identity.server(_SERVER, tuple(dict.fromkeys((*hosts, _LOCALHOST))))
        with _as_authority_error(folder):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder.chmod(0o700)  # it was there already
            _write_new(folder / "server.json5", _SERVER_HEAD + _text(_server(identity, server, hosts, port)))
            _write_new(folder / "ca.pem", identity.certificate.decode())
            _write_new(folder / "ca.key", identity.key.decode())
        return cls(folder)

    def clients(self) -> list[str]:
        """Names of the clients that the rules know."""
        return sorted(path.stem for path in (self.folder / "issued").glob("*.pem"))

    def add_client(self, name: str) -> Path:
        """Make a client known; its configuration. The server knows it after a restart.

        Raises:
            InvalidValueError: no name for a client.
            AuthorityError: the name was given before, or the server's configuration cannot be read.
        """
        if not is_name(name) or name in (_SERVER, ANONYMOUS):
            raise InvalidValueError(
                f"client: {NAME_EXPECTED}, not {_SERVER!r} nor {ANONYMOUS!r}, found {name!r}"
            )
        path = self.folder / "clients" / f"{name}.json5"
        with self._alone():
            if self._revoked(name).exists():
                # The certificate that was revoked has this name for ever, and would be let in again.
                raise AuthorityError(f"client {name!r} was revoked; choose another name")
            for made in (self._issued(name), path):
                if made.exists():
                    raise AuthorityError(f"client {name!r}: {made} is there already; nothing is overwritten")
            config = self._server()
            client = self._identity.client(name)
            endpoints = config.get("metadata", {}).get(_ENDPOINTS, [])
            self._write_rules(config, [*self.clients(), name])
            _write_new(self._issued(name), client.certificate.decode())
            _write_new(path, _HEAD + _text(_client(name, self._identity, client, endpoints)))
        return path

    def revoke(self, name: str) -> None:
        """Let a client do nothing any more, and give its name to nobody. The server knows after a restart.

        What was cut off is finished by the same call again.

        Raises:
            AuthorityError: no such client, or the server's configuration cannot be read.
        """
        with self._alone():
            config = self._server()
            if name in self.clients():
                (self.folder / "revoked").mkdir(mode=0o700, exist_ok=True)
                self._issued(name).rename(self._revoked(name))  # first: no later rules name the client
            elif not is_name(name) or not self._revoked(name).exists():
                known = ", ".join(self.clients()) or "none is"
                raise AuthorityError(f"client: expected one that is known ({known}), found {name!r}")
            self._write_rules(config, self.clients())
            (self.folder / "clients" / f"{name}.json5").unlink(missing_ok=True)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """One program at a time changes the folder."""
        with _as_authority_error(self.folder), (self.folder / "ca.pem").open() as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _issued(self, name: str) -> Path:
        return self.folder / "issued" / f"{name}.pem"

    def _revoked(self, name: str) -> Path:
        return self.folder / "revoked" / f"{name}.pem"

    def _server(self) -> Section:
        try:
            lines = self.server_config.read_text(encoding="utf-8").splitlines()
            config: Section = json.loads("\n".join(x for x in lines if not x.lstrip().startswith("//")))
            if not isinstance(config, dict):
                raise ValueError("something else than an object")
        except (OSError, ValueError) as error:
            raise AuthorityError(
                f"{self.server_config}: expected JSON, and lines of comment that begin with //, found {error}"
            ) from error
        return config

    def _write_rules(self, config: Section, clients: list[str]) -> None:
        config["access_control"] = access_control(_SERVER, clients)
        new = self.server_config.with_suffix(".new")
        new.unlink(missing_ok=True)
        _write_new(new, _SERVER_HEAD + _text(config))
        new.replace(self.server_config)


def _server(authority: Identity, server: Identity, hosts: tuple[str, ...], port: int) -> Section:
    reached = [f"tls/{f'[{host}]' if ':' in host else host}:{port}" for host in hosts or (_LOCALHOST,)]
    config = {
        # Not a peer: that would leave questions about liveliness to any client that calls itself a router.
        "mode": "router",
        "listen": {"endpoints": [f"tls/[::]:{port}"] if hosts else reached},
        **_common(authority, {"listen": server, "connect": server}),
        "metadata": {_ENDPOINTS: reached},
        "access_control": access_control(_SERVER, ()),
    }
    config["transport"]["link"]["rx"] = {"max_message_size": MESSAGE_HEADROOM * DecodeLimits().max_bytes}
    return config


def _client(name: str, authority: Identity, client: Identity, endpoints: list[str]) -> Section:
    return {
        "mode": "client",
        "connect": {"endpoints": endpoints, "timeout_ms": _CONNECT_TIMEOUT_MS},
        **_common(authority, {"connect": client}),
        "metadata": {CLIENT_SETTING: name},
    }


def _common(authority: Identity, shown: dict[str, Identity]) -> Section:
    """What both have: nobody is looked for, and both sides of a connection show a certificate."""
    tls: Section = {
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "root_ca_certificate_base64": base64.b64encode(authority.certificate).decode(),
    }
    for side, identity in shown.items():
        tls[f"{side}_certificate_base64"] = base64.b64encode(identity.certificate).decode()
        tls[f"{side}_private_key_base64"] = base64.b64encode(identity.key).decode()
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tls": tls}},
    }


def _text(config: Section) -> str:
    return json.dumps(config, indent=2) + "\n"


@contextmanager
def _as_authority_error(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise AuthorityError(f"{folder}: expected a folder to write to, found {error}") from error


def _write_new(path: Path, text: str) -> None:
    """Write a file that only its owner may read; FileExistsError where there is one."""
    path.parent.mkdir(mode=0o700, exist_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
