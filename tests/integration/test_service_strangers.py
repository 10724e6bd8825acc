"""What a client that plays false gets of the others: all where nothing guards the server, nothing with keys.

Each attack is tried on both wires by the same code. On the guarded one the attacker is a client whom the
authority has let in, in every mode that Zenoh has; a stranger does not even get that far.
"""

import base64
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from featuredb.cli.main import main
from featuredb.errors import ServiceError
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, list_candidates
from featuredb.store.candidates.states import ANONYMOUS
from reloc.client import NO_SERVER, Client, LiveTrack, TrackPose
from reloc.wire.query import encode
from reloc.wire.track import LiveStatus, TrackEvent, TrackFrame
from tests.support.events import watch_events
from tests.support.live import LENS, SOON_S, jpeg, wait_until
from tests.support.service import photo
from tests.support.strangers import Wire, config_of, free_port, guarded_wire, keys, open_wire, restarted

_ROOT = "featuredb/town"
_VICTIM, _ATTACKER = "alice", "mallory"
_FAR = 10**6  # of a frame that nobody has sent


@pytest.fixture(scope="module")
def unguarded() -> Iterator[Wire]:
    with open_wire() as wire:
        yield wire


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wire]:
    with guarded_wire(tmp_path_factory.mktemp("strangers") / "keys", _VICTIM, _ATTACKER) as wire:
        yield wire


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A wire with an attacker on it, and whether the attack should work."""

    wire: Wire
    attacker: zenoh.Session
    works: bool

    def settle(self) -> None:
        """What the attacker has declared is where the server is, and so is its own news."""
        assert [r for r in self.attacker.get(f"{_ROOT}/status", timeout=SOON_S) if r.ok is not None]

    def check(self, happens: Callable[[], bool], tries: int = 10) -> None:
        """Try the attack until it works, some times; it must where nothing guards, and must not else."""
        self.settle()
        assert any(happens() or time.sleep(0.02) for _ in range(tries)) == self.works


@pytest.fixture(params=["open client", "guarded client", "guarded peer", "guarded router"])
def scene(request: pytest.FixtureRequest) -> Iterator[Scene]:
    kind, mode = request.param.split()
    wire: Wire = request.getfixturevalue("unguarded" if kind == "open" else "guarded")
    with wire.attacker(_ATTACKER, mode) as session:
        yield Scene(wire=wire, attacker=session, works=kind == "open")


def test_a_forger_gets_no_photo_and_answers_nobody(scene: Scene) -> None:
    seen: list[bytes] = []
    with scene.wire.client(_VICTIM) as victim:
        forged = encode(victim.localise(photo()).model_copy(update={"detail": "forged"}))

        def answer(query: zenoh.Query) -> None:
            with query:
                if query.payload is not None:
                    seen.append(query.payload.to_bytes())
                    time.sleep(0.05)  # of several answers of one key Zenoh hands out the latest
                    query.reply(query.key_expr, forged)

        declared = [
            scene.attacker.declare_queryable(key, answer, complete=True)
            for key in (f"{_ROOT}/localise/*", f"{_ROOT}/localise/{_VICTIM}", "featuredb/**")
        ]
        scene.check(lambda: victim.localise(photo()).detail == "forged")
        for queryable in declared:
            queryable.undeclare()
    assert (photo() in seen) == scene.works


def test_an_eavesdropper_hears_nothing_of_a_live_session(scene: Scene) -> None:
    heard: set[str] = set()
    with scene.wire.client(_VICTIM) as victim, victim.track(LENS) as live:
        key = f"{_ROOT}/track/{_VICTIM}/{live.name}"
        for pattern in ("featuredb/**", f"{key}/*", f"{key}/frames", f"{key}/poses"):
            scene.attacker.declare_subscriber(pattern, lambda s: heard.add(str(s.key_expr)))

        def happens() -> bool:
            exchange(live)
            return {f"{key}/frames", f"{key}/poses"} <= heard

        scene.check(happens)
    assert bool(heard) == scene.works


def test_a_token_for_a_server_that_is_none_confuses_nobody(scene: Scene) -> None:
    with scene.attacker.liveliness().declare_token("featuredb/hamlet/servers/x"):

        def happens() -> bool:
            try:
                with scene.wire.client(_VICTIM) as victim:
                    assert victim.database == "town"
                    return False
            except ServiceError as error:
                if "hamlet" not in error.message:
                    raise
                return True

        scene.check(happens, tries=3)


def test_a_client_that_calls_itself_a_router_hides_no_server(guarded: Wire) -> None:
    with guarded.client(_VICTIM) as victim, guarded.attacker(_ATTACKER, "router") as attacker:
        attacker.liveliness().declare_token("featuredb/hamlet/servers/x")
        for _ in range(30):
            found = list(victim._session().liveliness().get("featuredb/*/servers/*", timeout=SOON_S))
            assert [str(r.ok.key_expr).split("/")[1] for r in found if r.ok is not None] == ["town"]


def test_a_token_of_another_client_keeps_no_session_open(scene: Scene) -> None:
    def gone() -> int:
        return live_status(scene.wire).ended.get("CLIENT_GONE", 0)

    with scene.wire.client(_VICTIM) as victim:
        before = gone()
        with victim.track(LENS) as live:
            token = f"{_ROOT}/track/{_VICTIM}/{live.name}/client"
            held = scene.attacker.liveliness().declare_token(token)
            scene.settle()
        end = time.monotonic() + (0.5 if scene.works else SOON_S)
        while gone() == before and time.monotonic() < end:
            time.sleep(0.01)
        assert (gone() == before) == scene.works
        held.undeclare()


def test_frames_put_into_another_client_s_session_are_not_taken(scene: Scene) -> None:
    def received() -> int:
        return live_status(scene.wire).frames.received

    with scene.wire.client(_VICTIM) as victim, victim.track(LENS) as live:
        before = received()
        key = f"{_ROOT}/track/{_VICTIM}/{live.name}/frames"

        def happens() -> bool:
            scene.attacker.put(key, jpeg(0), attachment=encode(TrackFrame(sequence=_FAR, time_s=1.0)))
            return received() > before

        scene.check(happens)


def test_poses_and_events_put_into_another_client_s_session_do_not_reach_it(scene: Scene) -> None:
    with scene.wire.client(_VICTIM) as victim, victim.track(LENS) as live:
        key = f"{_ROOT}/track/{_VICTIM}/{live.name}"
        forged = exchange(live).model_copy(update={"sequence": _FAR})

        def moved() -> bool:
            scene.attacker.put(f"{key}/poses", encode(forged))
            pose = live.next(0.02)
            return pose is not None and pose.sequence == _FAR

        scene.check(moved)
        over = TrackEvent(
            type="ended", session=live.name, code="FORGED", message="by another", sequence=None, time=""
        )

        def ended() -> bool:
            scene.attacker.put(f"{key}/events", encode(over))
            return end_of(live) == "FORGED"

        scene.check(ended)


@pytest.mark.parametrize("leaf", [f"localise/{_VICTIM}", f"track/{_VICTIM}/x", "localise/anonymous"])
def test_nobody_asks_in_another_client_s_name(scene: Scene, leaf: str) -> None:
    def happens() -> bool:
        replies = list(scene.attacker.get(f"{_ROOT}/{leaf}", payload=photo(), timeout=SOON_S))
        return any(reply.ok is not None for reply in replies)

    scene.check(happens, tries=3)


def test_a_client_s_events_are_the_server_s_own(scene: Scene) -> None:
    with scene.wire.client(_VICTIM) as victim, watch_events(victim) as events:
        event = {"type": "stopping", "database": "town", "server_id": "x", "snapshot": 1, "map_id": None}
        forged = json.dumps({**event, "detail": "forged", "time": ""}).encode()

        def happens() -> bool:
            scene.attacker.put(f"{_ROOT}/events", forged)
            return events.next(0.02) is not None

        scene.check(happens)


@pytest.mark.parametrize("kind", ["open", "guarded"])
def test_a_contribution_is_of_who_was_authenticated(
    request: pytest.FixtureRequest, tmp_path: Path, kind: str
) -> None:
    """Both give the other's name; the attacker's photo is his own all the same, and so is the victim's."""
    wire: Wire = request.getfixturevalue("unguarded" if kind == "open" else "guarded")
    wire.contributions.written.clear()
    for k, (name, claimed) in enumerate(((_VICTIM, _ATTACKER), (_ATTACKER, _VICTIM))):
        with wire.client(name) as client:
            reply = client.localise(photo(seed=k), contribute=True, credit=claimed, licence="CC0-1.0")
        assert reply.contribution is not None
        assert reply.contribution.accepted
        wait_until(lambda k=k: len(wire.contributions.written) > k, "the contribution")  # type: ignore[misc]
    database = Database.create(tmp_path / "db")
    contribute(database, wire.contributions.written)
    found = {c.credit: c.owner for c in list_candidates(database)}
    owners = (ANONYMOUS, ANONYMOUS) if kind == "open" else (_VICTIM, _ATTACKER)
    assert found == dict(zip((_ATTACKER, _VICTIM), owners, strict=True))


@pytest.mark.parametrize("who", ["a client", "nobody", "a client of another authority"])
def test_who_has_no_certificate_of_the_authority_stays_outside(
    guarded: Wire, tmp_path: Path, who: str
) -> None:
    assert guarded.keys is not None
    keys("init", tmp_path / "other")
    keys("client", tmp_path / "other", _VICTIM)
    its_own = guarded.keys if who == "a client" else tmp_path / "other"
    config = zenoh.Config.from_file(str(its_own / "clients" / f"{_VICTIM}.json5"))
    # The stranger knows the server's authority, so that it is the server who refuses.
    ca = json.dumps(base64.b64encode((guarded.keys / "ca.pem").read_bytes()).decode())
    config.insert_json5("transport/link/tls/root_ca_certificate_base64", ca)
    if who == "nobody":
        for part in ("certificate", "private_key"):
            config.insert_json5(f"transport/link/tls/connect_{part}_base64", "null")
        config.insert_json5("transport/link/tls/enable_mtls", "false")
    config.insert_json5("connect/endpoints", json.dumps(listening(guarded.keys)))
    config.insert_json5("connect/timeout_ms", "500")
    if who == "a client":
        zenoh.open(config).close()
    else:
        with pytest.raises(zenoh.ZError):
            zenoh.open(config)


@pytest.mark.parametrize("certificate", ["clients/mallory.json5", "server.json5"])
def test_a_client_s_certificate_is_no_server_s(guarded: Wire, certificate: str) -> None:
    assert guarded.keys is not None
    tls = config_of(guarded.keys / certificate)["transport"]["link"]["tls"]
    endpoint = f"tls/localhost:{free_port()}"
    false_server = zenoh.Config.from_file(str(guarded.keys / "server.json5"))
    for part in ("certificate", "private_key"):
        value = json.dumps(tls[f"connect_{part}_base64"])
        false_server.insert_json5(f"transport/link/tls/listen_{part}_base64", value)
    false_server.insert_json5("listen/endpoints", json.dumps([endpoint]))
    victim = zenoh.Config.from_file(str(guarded.keys / "clients" / f"{_VICTIM}.json5"))
    victim.insert_json5("connect/endpoints", json.dumps([endpoint]))
    victim.insert_json5("connect/timeout_ms", "500")
    with zenoh.open(false_server):
        if certificate == "server.json5":
            zenoh.open(victim).close()
        else:
            with pytest.raises(zenoh.ZError):
                zenoh.open(victim)


def test_who_is_revoked_gets_no_answer_once_the_server_has_restarted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "keys"
    with guarded_wire(folder, "phone", "tablet") as wire:
        stolen = (folder / "clients" / "phone.json5").read_bytes()
        with wire.client("phone") as phone:
            assert phone.localise(photo()).status == "localised"
        keys("revoke", folder, "phone")
    kept = tmp_path / "stolen.json5"
    kept.write_bytes(stolen)
    with restarted(folder) as wire:
        with pytest.raises(ServiceError) as failure:
            Client(config_path=kept, connect_timeout_s=0.5).open()
        assert failure.value.code == NO_SERVER
        with wire.client("tablet") as tablet:
            assert tablet.localise(photo()).status == "localised"
    assert main(["keys", "client", str(folder), "phone"]) == 2
    assert "revoked" in capsys.readouterr().err


def live_status(wire: Wire) -> LiveStatus:
    status = wire.server.status().live
    assert status is not None
    return status


def test_a_server_answers_the_clients_of_another_one_of_its_authority(guarded: Wire) -> None:
    assert guarded.keys is not None
    config = config_of(guarded.keys / "server.json5")
    config["connect"] = {"endpoints": listening(guarded.keys)}
    config["listen"]["endpoints"] = [f"tls/localhost:{free_port()}"]
    (guarded.keys / "second.json5").write_text(json.dumps(config))
    with (
        restarted(guarded.keys, "second.json5", "hamlet"),
        Client(database="hamlet", config_path=guarded.keys / "clients" / f"{_VICTIM}.json5") as client,
    ):
        assert client.localise(photo()).status == "localised"
        with client.track(LENS) as live:
            exchange(live)


def listening(folder: Path) -> list[str]:
    endpoints: list[str] = config_of(folder / "server.json5")["listen"]["endpoints"]
    return endpoints


def exchange(live: LiveTrack) -> TrackPose:
    """A frame and its pose."""
    live.send(jpeg(0), time.monotonic())
    pose = live.next(SOON_S)
    assert pose is not None
    return pose


def end_of(live: LiveTrack) -> str | None:
    """Why the session has ended; None where it has not."""
    try:
        live.next(0.05)
    except ServiceError as error:
        return error.code
    return None
