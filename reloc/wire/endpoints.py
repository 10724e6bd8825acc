"""Addresses of this machine alone."""

import ipaddress


def is_loopback(host: str) -> bool:
    """Whether a host name or address is reached by this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
