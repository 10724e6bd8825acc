"""`featuredb keys`: the folder of an authority."""

import stat
from pathlib import Path
from unittest.mock import Mock

import pytest
from cryptography import x509

from featuredb.cli.main import main
from reloc.authority import Authority
from tests.support.strangers import config_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    assert (
        main(["keys", "init", str(tmp_path / "keys"), "--host", "map.example.org", "--host", "2001:db8::7"])
        == 0
    )
    assert main(["keys", "client", str(tmp_path / "keys"), "phone"]) == 0
    return tmp_path / "keys"


def subjects(folder: Path) -> list[str]:
    found = config_of(folder / "server.json5")["access_control"]["subjects"]
    assert isinstance(found, list)
    return [name for subject in found for name in subject["cert_common_names"]]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_keys_are_for_their_owner_alone(folder: Path) -> None:
    files = [path for path in (folder, *folder.rglob("*")) if path.is_file()]
    assert {path.name for path in files} == {"ca.pem", "ca.key", "server.json5", "phone.json5", "phone.pem"}
    for path in (folder, *folder.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


def test_clients_are_told_where_the_server_is(folder: Path) -> None:
    assert config_of(folder / "clients" / "phone.json5")["connect"]["endpoints"] == [
        "tls/map.example.org:7447",
        "tls/[2001:db8::7]:7447",
    ]
    assert config_of(folder / "server.json5")["listen"]["endpoints"] == ["tls/[::]:7447"]


def test_a_client_s_certificate_is_one_of_a_client(folder: Path) -> None:
    found = x509.load_pem_x509_certificate((folder / "issued" / "phone.pem").read_bytes())
    authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    found.verify_directly_issued_by(authority)
    assert found.subject.rfc4514_string() == "CN=phone"
    uses = found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(uses) == [x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["init"], "nothing is overwritten"),
        (["client", "phone"], "nothing is overwritten"),
        (["client", "server"], "found 'server'"),
        (["client", "anonymous"], "found 'anonymous'"),
        (["client", "../phone"], "found '../phone'"),
        (["client", "*"], "found '*'"),
        (["revoke", "tablet"], "phone"),
    ],
)
def test_what_is_refused_changes_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    before = contents(folder)
    assert main(["keys", arguments[0], str(folder), *arguments[1:]]) == 2
    assert words in capsys.readouterr().err
    assert contents(folder) == before


@pytest.mark.parametrize("argument", ["--host=a b", "--host=-x.org", "--host=", "--port=0"])
def test_a_server_that_nobody_can_reach_is_refused(tmp_path: Path, argument: str) -> None:
    assert main(["keys", "init", str(tmp_path / "keys"), argument]) == 2
    assert not (tmp_path / "keys").exists()


def test_a_folder_that_is_no_authority_says_how_to_make_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["keys", "client", str(tmp_path), "phone"]) == 2
    assert f"featuredb keys init {tmp_path}" in capsys.readouterr().err


def test_a_revoke_that_was_cut_off_is_finished(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The client is in no rules that are written afterwards, and the same call again takes it out at once."""
    with monkeypatch.context() as cut:
        cut.setattr(Authority, "_write_rules", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            Authority(folder).revoke("phone")
    assert main(["keys", "client", str(folder), "tablet"]) == 0
    assert subjects(folder) == ["server", "tablet"]
    assert main(["keys", "revoke", str(folder), "phone"]) == 0
    assert not (folder / "clients" / "phone.json5").exists()


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["keys", "init", str(tmp_path / "file" / "keys")]) == 2
    assert "expected a folder to write to" in capsys.readouterr().err


def test_rules_come_and_go_and_the_rest_of_the_configuration_stays(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "server.json5"
    path.write_text("// ours\n" + path.read_text().replace("tls/[::]:7447", "tls/10.0.0.7:7447"))
    assert main(["keys", "client", str(folder), "tablet"]) == 0
    assert subjects(folder) == ["server", "phone", "tablet"]
    assert config_of(path)["listen"]["endpoints"] == ["tls/10.0.0.7:7447"]
    assert main(["keys", "revoke", str(folder), "phone"]) == 0
    assert subjects(folder) == ["server", "tablet"]
    assert (folder / "revoked" / "phone.pem").is_file()
    assert not (folder / "clients" / "phone.json5").exists()
    path.write_text("{mode: 'router'}")
    assert main(["keys", "client", str(folder), "watch"]) == 2
    assert "expected JSON" in capsys.readouterr().err
    assert path.read_text() == "{mode: 'router'}"
