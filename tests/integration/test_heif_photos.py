"""HEIC photos where JPEGs go: ingested, localised and asked of a server, portrait ones as landscape ones."""

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import featuredb
from featuredb.errors import IngestError, ServiceError
from featuredb.features.decode import DecodeLimits, decode_gray
from ingest.photos.scan import require_usable, scan_folder
from ingest.pipeline import IngestOptions, ingest_photos
from reloc.service.options import ServeOptions
from tests.support.hill_map import MAKING
from tests.support.hill_photos import FRAME, write_hill_photos
from tests.support.service import ScriptedLocaliser, client_of, photo, running_server

pillow_heif = pytest.importorskip("pillow_heif")
pillow_heif.register_heif_opener()


def _as_heic(jpeg: bytes, orientation: int = 1) -> bytes:
    with Image.open(io.BytesIO(jpeg)) as picture:
        exif = picture.getexif()
        exif[274] = orientation
        picture.info["exif"] = exif.tobytes()
        buffer = io.BytesIO()
        picture.save(buffer, "HEIF", quality=90)
    return buffer.getvalue()


@pytest.mark.slow
def test_a_folder_of_heic_becomes_a_map_that_answers_heic(tmp_path: Path) -> None:
    truth = write_hill_photos(tmp_path / "jpeg", columns=3, rows=2)
    (tmp_path / "heic").mkdir()
    for k, shot in enumerate(truth):
        data = _as_heic((tmp_path / "jpeg" / shot.name).read_bytes(), (1, 6, 8)[k % 3])
        (tmp_path / "heic" / shot.name.replace(".jpg", ".HEIC")).write_bytes(data)
    told, expected = (scan_folder(tmp_path / kind).photos for kind in ("heic", "jpeg"))
    assert [(p.width, p.height, p.camera_key, p.focal_px) for p in told] == [
        (p.width, p.height, p.camera_key.removesuffix("|jfif"), p.focal_px) for p in expected
    ]
    assert [p.orientation for p in told] == [1, 6, 8] * 2
    options = IngestOptions(workers=1, gps_sigma_m=(0.02, 0.02), making=MAKING)
    db = featuredb.open(tmp_path / "db", create=True)
    report = ingest_photos(db.store, tmp_path / "heic", options)
    assert report.count("registered") == len(truth)
    made = db.store.snapshot().load_map(report.maps[0].map_id)
    assert made.points.rgb.std() > 10
    for shot in truth[:3]:
        answer = db.localise(tmp_path / "heic" / shot.name.replace(".jpg", ".HEIC"))
        assert answer.utm is not None
        enu = FRAME.enu_from_utm(np.array([answer.utm]), 32632)[0]
        assert np.linalg.norm(enu - shot.cam_from_local.center) < 0.2


def test_the_server_takes_heic_within_its_limits() -> None:
    localiser = ScriptedLocaliser(1)
    plain = _as_heic(photo())
    limits = DecodeLimits(max_pixels=160 * 120)
    large = _as_heic(photo(size=(320, 240)))
    options = replace(ServeOptions(), limits=limits)
    with running_server(localiser, options) as server, client_of(server) as client:
        for wrong, code in ((large, "TOO_LARGE"), (plain[: len(plain) // 2], "BAD_IMAGE")):
            with pytest.raises(ServiceError) as refusal:
                client.localise(wrong)
            assert refusal.value.code == code
        assert client.localise(plain).status == "localised"
        assert client.localise(_as_heic(photo(), 6)).status == "localised"
    expected = decode_gray(photo()).astype(float)
    for gray in localiser.grays:
        assert gray.shape == expected.shape
        assert np.abs(gray - expected).mean() < 5


def test_without_the_extra_the_refusal_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "IMG_1.HEIC").write_bytes(_as_heic(photo(size=(640, 480))))
    cache = tmp_path.parent / f"{tmp_path.name}.json"
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pillow_heif", None)
        scanned = scan_folder(tmp_path, cache_file=cache)
    with pytest.raises(IngestError, match=r"1 unsupported; IMG_1.HEIC: .* pip install 'featuredb\[heic\]'"):
        require_usable(scanned, tmp_path)
    # Once it is installed, what was refused is not refused from memory.
    assert [p.status for p in scan_folder(tmp_path, cache_file=cache).photos] == ["ok"]
