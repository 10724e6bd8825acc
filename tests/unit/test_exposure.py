"""Where a server may listen without being told that it is insecure."""

import json

import pytest
import zenoh

from reloc.gateway.options import GatewayOptions
from reloc.gateway.serve import listen
from reloc.listening import ListenError
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.session import ServiceStartError, authenticates, check_exposure
from tests.support.service import MemorySource, ScriptedLocaliser, area_of

_TLS = {"transport": {"link": {"tls": {"enable_mtls": True}}}}
_RULES = {"access_control": {"enabled": True, "default_permission": "deny"}}
_ALONE = {"scouting": {"multicast": {"enabled": False}}}
_PASSWORDS = {"transport": {"auth": {"usrpwd": {"dictionary_file": "users.txt"}}}}


def config(listen: object = (), connect: object = (), mode: str = "router", **more: object) -> zenoh.Config:
    sides = {"listen": {"endpoints": listen}, "connect": {"endpoints": connect}}
    return zenoh.Config.from_json5(json.dumps({"mode": mode, **sides, **more}))


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/127.8.8.8:0",
        "tcp/localhost:7447",
        "tcp/[::1]:7447",
        "udp/127.0.0.1:7447?x=1#iface=lo",
        "unixsock-stream//tmp/socket",
    ],
)
def test_what_only_this_machine_reaches_needs_no_keys(endpoint: str) -> None:
    check_exposure(config([endpoint]))
    check_exposure(config([], [endpoint]))


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/192.168.1.7:7447",
        "tcp/localhost.example.org:7447",
        "ws/map.example.org:80",
        "udp/127.0.0.1.example.org:1",
        "serial/dev/ttyUSB0",
        "tls/0.0.0.0:7447",
    ],
)
def test_what_others_reach_is_refused_in_one_line_that_says_what_to_do(endpoint: str) -> None:
    with pytest.raises(ServiceStartError, match=r"keys init DIR.*--insecure") as refusal:
        check_exposure(config(["tcp/127.0.0.1:1", endpoint]))
    assert endpoint in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_tls_alone_is_not_enough_nor_are_rules_alone() -> None:
    everywhere = ["tls/0.0.0.0:7447"]
    check_exposure(config(everywhere, **_TLS, **_RULES))
    check_exposure(config(everywhere, **_PASSWORDS, **_RULES))
    lenient = {"access_control": {"enabled": True, "default_permission": "allow"}}
    for more in (_TLS, _RULES, {**_TLS, **lenient}, {**_RULES, "access_control": {"enabled": False}}):
        found = config(everywhere, **more)
        assert not authenticates(found)
        with pytest.raises(ServiceStartError):
            check_exposure(found)
    with pytest.raises(ServiceStartError):  # TLS here does not hide that tcp is open
        check_exposure(config([*everywhere, "tcp/0.0.0.0:7448"], **_TLS, **_RULES))


def test_zenoh_s_own_endpoints_and_those_by_mode_count() -> None:
    with pytest.raises(ServiceStartError, match=r"tcp/\[::\]:7447"):
        check_exposure(zenoh.Config.from_json5('{"mode": "router"}'))
    by_mode = {"router": ["tcp/127.0.0.1:1"], "peer": ["tcp/0.0.0.0:1"]}
    check_exposure(config(by_mode))
    check_exposure(config(by_mode, mode="client", **_ALONE))
    with pytest.raises(ServiceStartError, match=r"tcp/0\.0\.0\.0:1"):
        check_exposure(config(by_mode, mode="peer", **_ALONE))


def test_a_peer_that_looks_for_others_finds_strangers() -> None:
    here = ["tcp/127.0.0.1:1"]
    check_exposure(config(here, mode="peer", **_ALONE))
    check_exposure(config(here, mode="peer", **_TLS, **_RULES))
    with pytest.raises(ServiceStartError, match="multicast"):
        check_exposure(config(here, mode="peer"))
    check_exposure(config(here, mode="router"))
    told = {"scouting": {"multicast": {"autoconnect": {"router": ["router", "peer"]}}}}
    with pytest.raises(ServiceStartError, match="multicast"):
        check_exposure(config(here, mode="router", **told))


def test_a_router_elsewhere_is_asked_over_tls() -> None:
    check_exposure(config([], ["tls/router.example.org:7447"]))
    with pytest.raises(ServiceStartError):
        check_exposure(config([], ["tcp/router.example.org:7447"]))


def test_a_server_that_strangers_reach_starts_when_it_is_told_to() -> None:
    source = MemorySource(area_of(ScriptedLocaliser(1)))
    everywhere = ServeOptions(listen=("tcp/0.0.0.0:0",))
    with pytest.raises(ServiceStartError, match="--insecure"):
        Server.start(source, everywhere, "town")
    assert source.loads == 0  # it does not take the time to load maps first
    Server.start(source, ServeOptions(listen=("tcp/0.0.0.0:0",), insecure=True), "town").close()


def test_a_gateway_that_strangers_reach_starts_when_it_is_told_to() -> None:
    with pytest.raises(ListenError, match=r"proxy.*--insecure"):
        listen(GatewayOptions(host="0.0.0.0", port=0))
    for options in (GatewayOptions(port=0), GatewayOptions(host="0.0.0.0", port=0, insecure=True)):
        listen(options).close()
