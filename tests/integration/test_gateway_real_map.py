"""A real map with exact truth, a real localiser behind a real server, asked over HTTP."""

import base64
import io

import numpy as np
import pyproj
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from featuredb.geo.local_frame import LocalFrame
from featuredb.store import Database
from reloc.client import CameraRequest, Client
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from tests.support.gateway import geolocation, geopose_request, running_gateway
from tests.support.planar_map import (
    CAMERA,
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    field_texture,
    planar_map,
    render,
    view,
)

pytestmark = pytest.mark.slow

# As of test_service_real_map.py: half a pixel of keypoint noise at 40 m.
TOLERANCE_M, TOLERANCE_DEG = 0.05, 0.1


def test_a_photo_of_the_map_comes_back_with_its_true_place_over_http(tmp_path):
    truth = view(4, -6, 40, 10, 33)
    out = io.BytesIO()
    Image.fromarray(render(field_texture(1), truth, seed=50)).save(out, "PNG")
    database = Database.create(tmp_path / "field")
    database.commit_map(planar_map(1))
    lens = {"model": "PINHOLE", "modelParams": list(CAMERA.params)}
    request = geopose_request(
        base64.b64encode(out.getvalue()).decode(), imageFormat="PNG", size=[640, 480], params=lens
    )
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    request["sensorReadings"]["geolocationReadings"] = [
        geolocation(frame.latitude_deg, frame.longitude_deg, 30.0)
    ]
    with (
        start_server(database, ServeOptions(listen=("tcp/127.0.0.1:0",))) as server,
        Client(server.endpoints[0]) as client,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        response = gateway.post("/geopose", json=request)
        camera = CameraRequest(model="PINHOLE", width=640, height=480, params=CAMERA.params)
        reply = client.localise(out.getvalue(), camera=camera)
    assert response.status_code == 200, response.text
    answer = response.json()["geopose"]
    position, turn = answer["position"], answer["quaternion"]
    assert reply.position is not None
    # The clients' positions agree to well below what the photo tells; only the prior differs.
    assert position["lat"] == pytest.approx(reply.position.lat, abs=1e-7)
    assert position["lon"] == pytest.approx(reply.position.lon, abs=1e-7)

    # From latitude, longitude, height to the map's frame by PROJ alone, through the Cartesian Earth.
    earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    here = np.array(earth.transform(position["lon"], position["lat"], position["h"]))
    origin = np.array(earth.transform(frame.longitude_deg, frame.latitude_deg, frame.height_m))
    axes_at_origin = _east_north_up(frame.latitude_deg, frame.longitude_deg)
    assert np.linalg.norm(axes_at_origin @ (here - origin) - truth.center) < TOLERANCE_M

    enu_from_body = Rotation.from_quat([turn["x"], turn["y"], turn["z"], turn["w"]]).as_matrix()
    local_from_body = axes_at_origin @ _east_north_up(position["lat"], position["lon"]).T @ enu_from_body
    right, down, forward = truth.rotation
    wanted = np.column_stack([forward, -right, -down])  # the body's x, y, z
    angle = Rotation.from_matrix(local_from_body @ wanted.T).magnitude()
    assert np.degrees(angle) < TOLERANCE_DEG


def _east_north_up(lat: float, lon: float) -> np.ndarray:
    """Rows: the axes at a place on the ellipsoid in Earth-centred ones."""
    a, o = np.radians([lat, lon])
    east = np.array([-np.sin(o), np.cos(o), 0.0])
    up = np.array([np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)])
    return np.array([east, np.cross(up, east), up])
