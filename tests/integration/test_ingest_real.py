"""Ingest of real photos of strangers."""

from pathlib import Path

import pytest

from ingest.executor import InProcessExecutor
from ingest.photos.scan import ScanOptions, require_usable, scan_folder
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.sfm.mapper import SfmOptions
from ingest.workspace import Workspace

pytestmark = [pytest.mark.real_data, pytest.mark.evaluation]


def test_strangers_photos_without_exif(shared_data: Path, tmp_path: Path) -> None:
    """Seven of ten photos, half of them by long lenses: the usual focal length makes no reconstruction."""
    folder = shared_data / "sacre_coeur" / "mapping"
    if not folder.is_dir():
        pytest.skip(f"not there: {folder}")
    photos = list(require_usable(scan_folder(folder, ScanOptions()), folder, least=2))[:7]
    found = []
    for again in (False, True):
        options = MapMakingOptions(sfm=SfmOptions(focal_from_view_graph=again))
        workspace = Workspace(root=tmp_path)
        done = reconstruct_photos(photos, workspace, options, InProcessExecutor())
        found.append(max((len(model.rows) for model in done.reconstruction.models()), default=0))
    assert found[0] < 3
    assert found[1] >= 5
