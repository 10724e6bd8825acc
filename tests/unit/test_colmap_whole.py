"""Files of COLMAP models that are cut off, go on, or lie about counts are seen before COLMAP reads them."""

import struct
from pathlib import Path

import pycolmap
import pytest

from featuredb.errors import IngestError
from ingest.models_in.colmap_folder import check_whole

NAMES = ("cameras", "rigs", "frames", "images", "points3D")


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rigs of three cameras, as COLMAP itself writes them."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 4
    folder = tmp_path_factory.mktemp("model")
    pycolmap.synthesize_dataset(options).write_binary(str(folder))
    return folder


def test_whole_files_pass(model: Path) -> None:
    assert {file.stem for file in model.iterdir()} == set(NAMES)
    check_whole(model)


@pytest.mark.parametrize("name", NAMES)
def test_any_part_of_a_file_is_refused(model: Path, tmp_path: Path, name: str) -> None:
    data = (model / f"{name}.bin").read_bytes()
    for cut in range(0, len(data), max(1, len(data) // 200)):
        (tmp_path / f"{name}.bin").write_bytes(data[:cut])
        with pytest.raises(IngestError, match=rf"{name}.bin: .* break off after \d+ records"):
            check_whole(tmp_path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [10**6, 2**63])
def test_a_count_that_lies_is_refused(model: Path, tmp_path: Path, name: str, count: int) -> None:
    data = (model / f"{name}.bin").read_bytes()
    (tmp_path / f"{name}.bin").write_bytes(struct.pack("<Q", count) + data[8:])
    with pytest.raises(IngestError, match="break off after"):
        check_whole(tmp_path)


@pytest.mark.parametrize("name", NAMES)
def test_what_goes_on_after_the_last_record_is_refused(model: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / f"{name}.bin").write_bytes((model / f"{name}.bin").read_bytes() + b"more")
    with pytest.raises(IngestError, match="4 bytes after its"):
        check_whole(tmp_path)


def test_a_lens_that_is_none_is_refused(model: Path, tmp_path: Path) -> None:
    data = bytearray((model / "cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 4711)
    (tmp_path / "cameras.bin").write_bytes(data)
    with pytest.raises(IngestError, match="break off after 0 records"):
        check_whole(tmp_path)


def test_text_is_not_its_business(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE")
    check_whole(tmp_path)
