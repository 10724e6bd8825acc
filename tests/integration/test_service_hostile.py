"""Hostile queries: each costs one `reply_err` and no more."""

import io
import json
import random
import struct
import zlib

import pytest
from PIL import Image

from featuredb.errors import ServiceError
from reloc.wire.query import ErrorCode, LocaliseReply
from tests.support.service import ScriptedLocaliser, client_of, photo, running_server
from tools.attacks import png

QUERIES = 300


@pytest.fixture(scope="module")
def served():
    localiser = ScriptedLocaliser(1)
    with running_server(localiser) as server, client_of(server) as client:
        yield localiser, client


@pytest.mark.parametrize(
    ("width", "height", "code"),
    [
        (60_000, 60_000, "TOO_LARGE"),
        (2**31 - 1, 2**31 - 1, "TOO_LARGE"),
        (1_000_000, 70, "TOO_LARGE"),
        (16, 16, "BAD_IMAGE"),
        (0, 500, "BAD_IMAGE"),
        (640, 480, "BAD_IMAGE"),  # allowed by its header, but most pixels are missing
    ],
)
def test_a_bomb_or_a_lying_header_is_refused(served, width, height, code):
    localiser, client = served
    before = len(localiser.requests)
    with pytest.raises(ServiceError) as caught:
        client.localise(png(width, height, zlib.compress(bytes(5000))), timeout_s=5.0)
    assert caught.value.code == code
    assert len(localiser.requests) == before


def test_a_jpeg_whose_header_claims_four_billion_pixels_is_refused(served):
    _, client = served
    data = bytearray(photo())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", 65_535, 65_535)
    with pytest.raises(ServiceError) as caught:
        client.localise(bytes(data), timeout_s=5.0)
    assert caught.value.code == "TOO_LARGE"


@pytest.mark.parametrize("fmt", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.95, 0.999])
def test_a_truncated_file_is_a_bad_image(served, fmt, share):
    _, client = served
    data = photo(fmt)
    with pytest.raises(ServiceError) as caught:
        client.localise(data[: int(share * len(data))], timeout_s=5.0)
    assert caught.value.code == "BAD_IMAGE"


@pytest.mark.parametrize("fmt", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
def test_the_whole_file_of_each_format_is_taken(served, fmt):
    localiser, client = served
    assert client.localise(photo(fmt)).status == "localised"
    assert localiser.grays[-1].shape == (120, 160)


def test_exif_orientation_is_not_applied(served):
    localiser, client = served
    exif = Image.Exif()
    exif[274] = 6  # turn by 90 degrees for display
    assert client.localise(photo(exif=exif)).status == "localised"
    assert localiser.grays[-1].shape == (120, 160)


def test_exif_gives_focal_length_key_and_on_request_the_position(served):
    localiser, client = served
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", "Model 1"
    exif.get_ifd(34665)[41989] = 36  # focal length in 35 mm film: the frame's diagonal is 43.27 mm
    exif.get_ifd(34853).update({1: "N", 2: (49.0, 30.0, 0.0), 3: "W", 4: (8.0, 15.0, 0.0)})
    data = photo(size=(160, 120), exif=exif)
    client.localise(data)
    assert localiser.requests[-1].exif_focal_px == pytest.approx(36 / 43.2666 * 200.0, rel=1e-3)
    assert "maker|model 1" in (localiser.requests[-1].camera_key or "")
    assert localiser.requests[-1].own_position is None
    client.localise(data, exif_prior=True)
    assert localiser.requests[-1].prior is None
    position = localiser.requests[-1].own_position
    assert position is not None
    assert (position.latitude_deg, position.longitude_deg) == pytest.approx((49.5, -8.25))


def _random_json(rng: random.Random, depth: int = 0) -> object:
    names = ["request_id", "camera", "prior", "options", "contribute", "lat", "lon", "sigma_m", "params", "x"]
    kind = rng.randrange(9 if depth < 4 else 6)
    if kind == 0:
        return rng.choice([None, True, False])
    if kind == 1:
        return rng.choice([0, -1, 1, 2**31, 10**30, -(10**400), 1.5, 1e308])
    if kind == 2:
        return rng.choice(["", "a", "\x00", "é" * 50, "PINHOLE", "../../etc", "9" * 5000])
    if kind in (3, 4, 5):
        return rng.random() * 10 ** rng.randrange(-10, 10)
    if kind == 6:
        return [_random_json(rng, depth + 1) for _ in range(rng.randrange(5))]
    return {rng.choice(names): _random_json(rng, depth + 1) for _ in range(rng.randrange(5))}


def _attachment(rng: random.Random) -> bytes | None:
    good = {
        "request_id": "fuzz",
        "prior": {"lat": 49.0, "lon": 8.4, "sigma_m": 10.0},
        "camera": {"model": "PINHOLE", "width": 160, "height": 120, "params": [150.0, 150.0, 80.0, 60.0]},
        "options": {"inliers": True},
    }
    kind = rng.randrange(7)
    if kind == 0:
        return None
    if kind == 1:
        return rng.randbytes(rng.randrange(300))
    if kind == 2:
        return json.dumps(_random_json(rng)).encode()
    if kind == 3:  # a good one with one value replaced
        section = rng.choice(list(good))
        good[section] = _random_json(rng)
        return json.dumps(good).encode()
    if kind == 4:  # a good one with bytes flipped
        text = bytearray(json.dumps(good).encode())
        for _ in range(rng.randrange(1, 6)):
            text[rng.randrange(len(text))] = rng.randrange(256)
        return bytes(text)
    if kind == 5:
        return rng.choice(
            [b"[" * 60_000, b'{"a":' * 9000, b"NaN", b"1e999", b'"' + b"a" * 60_000 + b'"', b"\xef\xbb\xbf{}"]
        )
    return json.dumps(good).encode()


def _payload(rng: random.Random) -> bytes | None:
    data = bytearray(photo(rng.choice(["JPEG", "PNG", "WEBP", "TIFF", "BMP"]), seed=rng.randrange(5)))
    kind = rng.randrange(7)
    if kind == 0:
        return None
    if kind == 1:
        return rng.randbytes(rng.randrange(2000))
    if kind == 2:
        return bytes(data[: rng.randrange(len(data))])
    if kind == 3:  # flipped within the header
        for _ in range(rng.randrange(1, 10)):
            data[rng.randrange(min(64, len(data)))] = rng.randrange(256)
        return bytes(data)
    if kind == 4:  # flipped anywhere
        for _ in range(rng.randrange(1, 40)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        return bytes(data)
    if kind == 5:
        return bytes(data[:20]) + rng.randbytes(rng.randrange(500))
    return bytes(data)


def test_fuzzed_queries_each_get_one_answer_and_the_server_lives(served):
    _, client = served
    session = client._session()
    rng = random.Random(20)
    outcomes: dict[str, int] = {}
    before = client.status().queries
    for number in range(QUERIES):
        replies = list(
            session.get(
                "featuredb/town/localise/anonymous",
                payload=_payload(rng),
                attachment=_attachment(rng),
                timeout=10,
            )
        )
        assert len(replies) == 1, f"query {number} got {len(replies)} answers"
        reply = replies[0]
        if reply.ok is not None:
            code = LocaliseReply.model_validate_json(reply.ok.payload.to_bytes()).status
        else:
            code = json.loads(reply.err.payload.to_bytes())["code"]
        outcomes[code] = outcomes.get(code, 0) + 1
    assert set(outcomes) <= {"localised", *(c.value for c in ErrorCode)}
    assert "INTERNAL" not in outcomes, "a hostile query found a defect"
    assert "DEADLINE" not in outcomes
    # The mixture reached all three ends, so the test tests something.
    assert min(outcomes[c] for c in ("localised", "BAD_REQUEST", "BAD_IMAGE")) >= 10
    after = client.status().queries
    assert after.received - before.received == QUERIES
    assert client.localise(photo()).status == "localised"


def test_a_slowly_decoding_but_legal_picture_is_answered(served):
    localiser, client = served
    out = io.BytesIO()
    Image.new("L", (9000, 8000), 90).save(out, "PNG")
    reply = client.localise(out.getvalue())
    assert reply.status == "localised"
    assert localiser.grays.pop().shape == (8000, 9000)
