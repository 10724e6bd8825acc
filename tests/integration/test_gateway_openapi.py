"""The OpenAPI document says what the gateway does: what it allows never is a defect."""

import json

import jsonschema
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from schemathesis import GenerationMode

from reloc.gateway.failures import STATUS_OF
from tests.support.gateway import geopose_request, running_gateway
from tests.support.service import ScriptedLocaliser, photo, running_server

EXAMPLES = 50  # for each operation and mode; what the gateway refuses takes milliseconds


@pytest.fixture(scope="module")
def gateway():
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0]) as running,
    ):
        yield running


@pytest.fixture(scope="module")
def document(gateway):
    return gateway.get("/openapi.json").json()


def test_the_document_has_every_route_and_only_statuses_that_there_are(document):
    assert {(method, path) for path, item in document["paths"].items() for method in item} == {
        ("post", "/geopose"),
        ("get", "/geopose"),
        ("post", "/localise"),
        ("get", "/maps"),
        ("get", "/health"),
        ("get", "/metrics"),
    }
    for item in document["paths"].values():
        for operation in item.values():
            said = {int(status) for status in operation["responses"]} - {200}
            assert said <= set(STATUS_OF.values())


def test_a_request_is_as_the_document_says(document):
    content = document["paths"]["/geopose"]["post"]["requestBody"]["content"]["application/json"]
    schema = {**content["schema"], "components": document["components"]}
    jsonschema.validate(geopose_request(photo()), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({}, schema)


def test_answers_are_as_the_document_says(gateway, document):
    def schema_of(path: str, method: str, status: str) -> dict:
        content = document["paths"][path][method]["responses"][status]["content"]["application/json"]
        return {**content["schema"], "components": document["components"]}

    good = gateway.post("/geopose", json=geopose_request(photo()))
    jsonschema.validate(good.json(), schema_of("/geopose", "post", "200"))
    jsonschema.validate(gateway.post("/geopose", json={}).json(), schema_of("/geopose", "post", "400"))
    form = gateway.post("/localise", files={"image": ("p.jpg", photo())})
    jsonschema.validate(form.json(), schema_of("/localise", "post", "200"))
    for path in ("/maps", "/health"):
        jsonschema.validate(gateway.get(path).json(), schema_of(path, "get", "200"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path", "mode"),
    [
        ("POST", "/geopose", GenerationMode.POSITIVE),
        ("POST", "/geopose", GenerationMode.NEGATIVE),
        ("POST", "/localise", GenerationMode.POSITIVE),
        ("POST", "/localise", GenerationMode.NEGATIVE),
        ("GET", "/maps", GenerationMode.POSITIVE),  # without parameters there is nothing to break
        ("GET", "/health", GenerationMode.POSITIVE),
        ("GET", "/metrics", GenerationMode.POSITIVE),
    ],
)
def test_nothing_that_the_document_allows_or_forbids_is_a_defect(gateway, document, method, path, mode):
    """Bodies by the schemas, and bodies that break them; each answer is one that is documented."""
    operation = schemathesis.openapi.from_dict(document)[path][method]
    documented = {int(status) for status in operation.definition.raw["responses"]}
    seen: set[int] = set()

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def ask(data):
        case = data.draw(operation.as_strategy(generation_mode=mode))
        response = case.call(base_url=gateway.url)
        seen.add(response.status_code)
        assert response.status_code in documented, response.text
        if response.status_code != 200:
            assert json.loads(response.text)["code"]

    ask()
    assert 200 not in seen if mode is GenerationMode.NEGATIVE else seen
