"""X.509 certificates of a small authority; keys are of the curve P-256."""

import ipaddress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Self

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

# Who may come in is for the access rules to say, not for dates: a phone that is forgotten goes on working.
_VALID = timedelta(days=3650)
_CLOCKS_DIFFER = timedelta(days=1)  # a device that was just switched on may be behind


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """A certificate and its private key, both PEM."""

    certificate: bytes
    key: bytes

    @classmethod
    def authority(cls) -> Self:
        """An authority, which signs the certificates of others and nothing else."""
        key, name = ec.generate_private_key(ec.SECP256R1()), _name("featuredb authority")
        builder = (
            _builder(name, name, key)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs_certificates=True), critical=True)
        )
        return cls._made(builder, key, key)

    def server(self, name: str, hosts: tuple[str, ...]) -> "Identity":
        """A server's, signed by this authority; clients that connect to another host refuse it."""
        uses = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        return self._signed(name, uses, x509.SubjectAlternativeName([_host(host) for host in hosts]))

    def client(self, name: str) -> "Identity":
        """A client's, signed by this authority; it cannot be a server's."""
        return self._signed(name, [ExtendedKeyUsageOID.CLIENT_AUTH])

    def _signed(
        self, name: str, uses: list[x509.ObjectIdentifier], *extensions: x509.ExtensionType
    ) -> "Identity":
        issuer = x509.load_pem_x509_certificate(self.certificate)
        issuer_key = serialization.load_pem_private_key(self.key, password=None)
        assert isinstance(issuer_key, ec.EllipticCurvePrivateKey)
        key = ec.generate_private_key(ec.SECP256R1())
        builder = (
            _builder(_name(name), issuer.subject, key)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        )
        for extension in extensions:
            builder = builder.add_extension(extension, critical=False)
        return Identity._made(builder, key, issuer_key)

    @classmethod
    def _made(
        cls,
        builder: x509.CertificateBuilder,
        key: ec.EllipticCurvePrivateKey,
        issuer_key: ec.EllipticCurvePrivateKey,
    ) -> Self:
        return cls(
            certificate=builder.sign(issuer_key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM),
            key=key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            ),
        )


def _builder(name: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS_DIFFER)
        .not_valid_after(now + _VALID)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    signs = {"digital_signature": not signs_certificates}
    signs |= dict.fromkeys(("key_cert_sign", "crl_sign"), signs_certificates)
    encrypts = ("key_encipherment", "data_encipherment", "key_agreement", "encipher_only", "decipher_only")
    return x509.KeyUsage(**signs, content_commitment=False, **dict.fromkeys(encrypts, False))


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)
