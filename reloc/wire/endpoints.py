"""Where servers listen, and which addresses are of this machine alone."""

import ipaddress

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # Zenoh's own port, this machine only


def is_loopback(host: str) -> bool:
    """Whether a host name or address is reached by this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
