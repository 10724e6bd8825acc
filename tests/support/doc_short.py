"""The documentation in short."""

from pathlib import Path

import pytest

from featuredb.features.extractor import ExtractorOptions
from ingest import anchoring, pipeline
from ingest.cli import video
from ingest.register.anchor import frames, placing, together
from tests.support.remembered import remembered

FEATURES = 1500  # of a photo


def shorten(patch: pytest.MonkeyPatch, work: Path) -> None:
    """Commands start no workers, which take long, and what the same photo gave before is not sought anew.

    docs/anchoring.md and the tutorials register the same frames on the same scan, two that agree. Several
    pages make a map of the same photos, each in a database of its own: they have one work folder, `work`.
    A map of few features is adjusted and compared sooner; how good it is, the demo says.
    """
    patch.setattr("os.cpu_count", lambda: 1)
    patch.setattr(pipeline, "default_root", lambda database_url: work)
    patch.setitem(ExtractorOptions.__init__.__kwdefaults__, "max_features", FEATURES)
    patch.setattr(video, "_FEATURES", FEATURES)
    patch.setattr(anchoring, "FRAMES", 2)
    patch.setattr(frames, "register_frame", remembered(frames.register_frame))
    patch.setattr(frames, "fit_vouched_for", remembered(frames.fit_vouched_for))
    for name in ("evidence_of", "fitted_together", "fit_vouched_for"):
        patch.setattr(together, name, remembered(getattr(together, name)))
    patch.setattr(placing, "adjust_to_scan", remembered(placing.adjust_to_scan))
