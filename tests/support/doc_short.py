"""The documentation in short."""

import pytest

from featuredb.features.extractor import ExtractorOptions
from ingest.cli import video
from ingest.register.anchor import frames
from ingest.register.anchor.anchor_map import AnchorOptions
from tests.support.remembered import remembered

FEATURES = 1500  # of a photo


def shorten(patch: pytest.MonkeyPatch) -> None:
    """Commands start no workers, which take long, and what the same photo gave before is not sought anew.

    docs/anchoring.md and the tutorials register the same frames on the same scan, two that agree.
    A map of few features is adjusted and compared sooner; how good it is, the demo says.
    """
    patch.setattr("os.cpu_count", lambda: 1)
    patch.setitem(ExtractorOptions.__init__.__kwdefaults__, "max_features", FEATURES)
    patch.setattr(video, "_FEATURES", FEATURES)
    patch.setitem(AnchorOptions.__init__.__kwdefaults__, "frames", 2)
    patch.setattr(frames, "register_frame", remembered(frames.register_frame))
