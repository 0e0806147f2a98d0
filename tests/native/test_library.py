"""The binding's structs are those of the header; without a library the error says why."""

import ctypes
import re
import sys
from pathlib import Path

import pytest

from scp_mpc.errors import MissingCoreError
from scp_mpc.native import library

HEADER = (Path(library.__file__).parent / "scp_mpc.h").read_text()
STRUCTS = {
    "scp_dynamics": library.Dynamics,
    "scp_problem": library.ProblemStruct,
    "scp_inputs": library.Inputs,
    "scp_iterate": library.IterateStruct,
    "scp_candidate": library.CandidateStruct,
    "scp_outputs": library.Outputs,
}
KINDS = {
    "int": ctypes.c_int,
    "double": ctypes.c_double,
    "uint8_t": ctypes.c_uint8,
    "scp_model": ctypes.c_int,
    "scp_inflation": ctypes.c_int,
    "scp_status": ctypes.c_int,
    "void": None,
} | STRUCTS
LENGTHS = {"SCP_MOST_CANDIDATES": library.MOST_CANDIDATES}


def kind_of(base, stars, length):
    kind = KINDS[base]
    if stars:
        return ctypes.c_void_p if kind is None else ctypes.POINTER(kind)
    return kind * (LENGTHS.get(length) or int(length)) if length else kind


def member(text):
    """Names and types of one declaration; those of a function pointer's arguments as they are."""
    function = re.match(r"(\w+) \(\*(\w+)\)\((.*)\)$", text)
    if function:
        base, name, arguments = function.groups()
        given = [re.match(r"(?:const )?(\w+) ?(\*?)", a.strip()) for a in arguments.split(",")]
        kinds = [ctypes.c_void_p if g[2] else KINDS[g[1]] for g in given]
        return [(name, (KINDS[base], *kinds))]
    base, names = re.match(r"(?:const )?(\w+) (.*)$", text).groups()
    parts = [re.match(r"(\*?)(\w+)(?:\[(\w+)\])?$", name.strip()) for name in names.split(",")]
    return [
        (name, kind_of(base, stars, length)) for stars, name, length in (p.groups() for p in parts)
    ]


def members(struct):
    body = re.search(r"typedef struct \{([^{}]*)\} " + struct + ";", HEADER)[1]
    body = re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL)
    texts = [" ".join(text.split()) for text in body.split(";")]
    return [pair for text in texts if text for pair in member(text)]


@pytest.mark.parametrize("name", STRUCTS)
def test_structs_mirror_the_header(name):
    mirrored = [
        (member, (kind._restype_, *kind._argtypes_) if hasattr(kind, "_argtypes_") else kind)
        for member, kind in STRUCTS[name]._fields_
    ]
    assert mirrored == members(name)


def test_functions_are_those_of_the_header():
    assert set(library._FUNCTIONS) == set(re.findall(r"SCP_API [^;(]*?(scp_\w+)\(", HEADER))


def test_constants_are_those_of_the_header():
    for name, value in (("SCP_VERSION", library.VERSION), *LENGTHS.items()):
        assert int(re.search(name + r" = (\d+)", HEADER)[1]) == value


def test_without_a_library_the_error_says_why_and_how_to_get_it(tmp_path):
    with pytest.raises(MissingCoreError, match=r"_core.so is not there\. It is compiled"):
        library.loaded(tmp_path)
    (tmp_path / "not_built.txt").write_text("no C compiler is there\n")
    with pytest.raises(MissingCoreError, match=r"no C compiler is there\. .*install a C compiler"):
        library.loaded(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="other loaders say other things")
def test_a_library_that_does_not_load_is_as_good_as_none(tmp_path):
    (tmp_path / "_core.so").write_bytes(b"of another machine")
    with pytest.raises(MissingCoreError, match=r"invalid ELF header|too short"):
        library.loaded(tmp_path)
