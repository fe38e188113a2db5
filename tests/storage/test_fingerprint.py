import json
import os

from imfvla.storage.fingerprint import code_version, describe_code, fingerprint, physical_cores


def test_is_json_and_complete():
    found = json.loads(json.dumps(fingerprint(threads=2)))
    assert set(found) == {"code", "machine", "packages", "threads"}
    assert found["packages"]["torch"].startswith("2.")
    assert found["machine"]["cpu"]


def test_cores_are_at_most_those_allowed():
    assert 1 <= physical_cores() <= len(os.sched_getaffinity(0))


def test_code_version_names_the_package_version():
    assert set(code_version()) == {"version", "commit", "dirty", "changes"}


def test_code_is_described_by_its_commit_and_its_changes():
    code = {"version": "1", "commit": "ab" * 20, "dirty": False, "changes": None}
    assert describe_code(code) == "abababababab"
    assert describe_code(code | {"dirty": True, "changes": "12"}) == "abababababab with changes 12"
    assert describe_code({"version": "1", "commit": None, "dirty": None}) == "version 1"
    assert describe_code("abc") == "unknown"
