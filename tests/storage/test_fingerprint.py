import json
import os

from imfvla.storage.fingerprint import code_version, fingerprint, physical_cores


def test_is_json_and_complete():
    found = json.loads(json.dumps(fingerprint(threads=2)))
    assert set(found) == {"code", "machine", "packages", "threads"}
    assert found["packages"]["torch"].startswith("2.")
    assert found["machine"]["cpu"]


def test_cores_are_at_most_those_allowed():
    assert 1 <= physical_cores() <= len(os.sched_getaffinity(0))


def test_code_version_names_the_package_version():
    assert set(code_version()) == {"version", "commit", "dirty"}
