"""The transport's share of a query."""

import numpy as np

from tools.measure_transport import measure, noise_jpeg


def test_transport_of_a_500_kb_photo_takes_under_10_ms():
    data = noise_jpeg(500)
    assert 400_000 < len(data) < 600_000
    transport, decoding = measure(data, queries=20)
    assert transport.min() >= 0, "the server cannot take longer than the client waits"
    assert np.median(transport) < 10.0
    assert np.median(decoding) < 100.0  # about 10 ms on an idle core; the bound is for loaded ones
