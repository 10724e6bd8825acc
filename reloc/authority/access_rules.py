"""Zenoh's access rules of a server: what each client may send and hear, by the name in its certificate."""

from collections.abc import Iterable
from typing import Any

from reloc.wire.keys import Keys

_KEYS = Keys(database="*")
_IN, _OUT = "ingress", "egress"
_ALL = [
    *("put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
]

Section = dict[str, Any]


def access_control(server: str, clients: Iterable[str]) -> Section:
    """The section `access_control` of a server's Zenoh configuration: what no rule allows is dropped.

    Args:
        server: name in the certificates of other servers, which may do all.
        clients: names in those of clients; each may ask, and has live sessions of its own.
    """
    serve, common = _rule("serve", [_IN, _OUT], _ALL, [_KEYS.of("**")]), _common()
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


def _common() -> list[Section]:
    """What all clients may: ask a server about itself, find it, hear its events."""
    about = [_KEYS.of("status"), _KEYS.of("maps")]
    offered = [*about, _KEYS.localise("*"), _KEYS.track("*", "*")]
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
    asked = [_KEYS.localise(client), _KEYS.track(client, "*")]
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
