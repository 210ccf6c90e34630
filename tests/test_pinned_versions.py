"""`.ci/requirements.txt` pins every package of the tests, as pyproject.toml allows."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent


def wanted():
    """The packages that `pip install '.[test]'` asks for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found, extras = project["dependencies"], ["test"]
    for extra in extras:
        for text in project["optional-dependencies"][extra]:
            requirement = Requirement(text)
            if requirement.name == project["name"]:
                extras += sorted(requirement.extras - set(extras))
            else:
                found.append(text)
    return [Requirement(text) for text in found]


def pinned():
    lines = (ROOT / ".ci" / "requirements.txt").read_text().splitlines()
    pins = [Requirement(line.rstrip("\\ ")) for line in lines if "==" in line]
    return {canonicalize_name(pin.name): str(pin.specifier).removeprefix("==") for pin in pins}


def test_every_package_of_the_tests_is_pinned():
    """Otherwise CI would test with versions that nobody has written down."""
    versions, requirements = pinned(), wanted()
    assert {"jax", "flatbuffers", "rosbags", "libigl", "pypcd4", "pytest"} <= {
        requirement.name for requirement in requirements
    }
    for requirement in requirements:
        version = versions.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement} is not pinned"
        assert requirement.specifier.contains(version), f"{requirement}, but {version} is pinned"
