"""Damage to files, for the tests that no file can crash a reader."""

from hypothesis import strategies as st

from stereokit.errors import InputError


@st.composite
def damaged(draw: st.DrawFn, originals: list[bytes]) -> bytes:
    """One of the files cut short, with bytes overwritten, dropped or inserted, or nothing but noise."""
    data = bytearray(draw(st.sampled_from([*originals, b""])))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data), 64)) | st.integers(0, 64))
        noise = draw(
            st.binary(max_size=16)
            | st.sampled_from([b"\xff" * 4, b"\0" * 4, b"1000000000", b"-1", b"nan", b"#", b"\n", b"\x7f\xff\xff\xff"])
        )
        kind = draw(st.sampled_from(["cut", "overwrite", "insert", "drop"]))
        if kind == "cut":
            del data[at:]
        elif kind == "overwrite":
            data[at : at + len(noise)] = noise
        elif kind == "insert":
            data[at:at] = noise
        else:
            del data[at : at + len(noise)]
    return bytes(data)


def outcome(read, path):
    """What a reader makes of a file: its result, or the one line of its error. Anything else is a failure."""
    try:
        return read(path)
    except InputError as error:
        message = str(error)
    assert len(message.splitlines()) == 1
    assert len(message) < 1000
    return message
