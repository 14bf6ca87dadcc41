"""Messages of several frames: put together as sent, whatever is lost, interleaved or asked for again."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.canbus.j1939 import (
    ABORT,
    BAM,
    CTS,
    DATA,
    END,
    MANAGEMENT,
    MAX_BYTES,
    MAX_PAUSE,
    MIN_BYTES,
    PACKET_BYTES,
    RTS,
    Assembler,
    WholeMessage,
)

GROUP, OTHER, EVERYONE = 65226, 65227, 0xFF
Frame = tuple[int, tuple[int, int], bytes]


def transfer_frames(group: int, data: bytes, kind: int = BAM) -> list[tuple[int, bytes]]:
    """Parameter group and content of the frames of a message: its announcement and its packets."""
    packets = [data[at : at + PACKET_BYTES] for at in range(0, len(data), PACKET_BYTES)]
    announcement = bytes([kind, *len(data).to_bytes(2, "little"), len(packets), 0xFF, *group.to_bytes(3, "little")])
    numbered = [bytes([number, *packet]).ljust(8, b"\xff") for number, packet in enumerate(packets, start=1)]
    return [(MANAGEMENT, announcement), *((DATA, packet) for packet in numbered)]


def frames_of(data: bytes, source: int = 1, destination: int = EVERYONE, group: int = GROUP) -> list[Frame]:
    kind = BAM if destination == EVERYONE else RTS
    return [(number, (source, destination), content) for number, content in transfer_frames(group, data, kind)]


def control(kind: int, *content: int) -> Frame:
    """A frame by which the receiver 2 controls a transfer from 1."""
    return MANAGEMENT, (2, 1), bytes([kind, *content]).ljust(5, b"\xff") + GROUP.to_bytes(3, "little")


def taken(assembler: Assembler, frames: list[Frame], begin: float = 0.0, step: float = 0.05) -> list[bytes]:
    def whole() -> Iterator[WholeMessage]:
        for index, (group, pair, data) in enumerate(frames):
            if (message := assembler.take(group, pair, data, begin + step * index)) is not None:
                yield message

    return [bytes(message.data) for message in whole()]


messages = st.binary(min_size=MIN_BYTES, max_size=200) | st.binary(min_size=MAX_BYTES, max_size=MAX_BYTES)


@pytest.mark.full
@given(st.lists(messages, min_size=1, max_size=4), st.data())
def test_messages_of_several_nodes_are_put_together_however_their_frames_interleave(
    contents: list[bytes], data: st.DataObject
) -> None:
    waiting = [frames_of(content, source) for source, content in enumerate(contents)]
    assembler, whole = Assembler({GROUP}), []
    while left := [frames for frames in waiting if frames]:
        frames = data.draw(st.sampled_from(left))
        whole += taken(assembler, [frames.pop(0)])
    assert sorted(whole) == sorted(contents)
    assert assembler.broken.count == 0


@settings(max_examples=300)
@given(st.lists(st.binary(min_size=MIN_BYTES, max_size=40), min_size=1, max_size=6), st.data())
def test_whatever_is_lost_or_repeated_no_message_is_wrong(contents: list[bytes], data: st.DataObject) -> None:
    """A node sends its messages seconds apart, as the standard has it: what is left of one never completes another."""
    assembler = Assembler({GROUP})
    for number, content in enumerate(contents):
        frames = frames_of(content)
        copies = data.draw(st.lists(st.sampled_from([0, 1, 1, 1, 2]), min_size=len(frames), max_size=len(frames)))
        received = [frame for frame, count in zip(frames, copies, strict=True) for _ in range(count)]
        whole = taken(assembler, received, 10.0 * number)
        assert whole in ([], [content])
        if set(copies) == {1}:
            assert whole == [content]


@given(st.lists(st.tuples(st.sampled_from([MANAGEMENT, DATA]), st.binary(max_size=9)), max_size=50))
def test_random_frames_do_no_harm(frames: list[tuple[int, bytes]]) -> None:
    assembler = Assembler({GROUP})
    taken(assembler, [(group, (1, EVERYONE), data) for group, data in frames])
    assert taken(assembler, frames_of(b"good" * 5), 100.0) == [b"good" * 5]


def test_packets_that_the_receiver_asks_for_again_are_taken_once() -> None:
    content = bytes(range(30))
    announced, *packets = frames_of(content, 1, 2)
    frames = [announced, control(CTS, 2, 1), *packets[:2], control(CTS, 0, 3), control(CTS, 3, 2), *packets[1:]]
    assembler = Assembler({GROUP})
    assert taken(assembler, [*frames, control(END)]) == [content]
    assert assembler.broken.count == 0


@pytest.mark.parametrize("ends", [[control(ABORT, 3)], [control(END)], [control(CTS, 2, 4)]])
def test_a_transfer_that_ends_early_is_counted(ends: list[Frame]) -> None:
    assembler = Assembler({GROUP})
    assert taken(assembler, [*frames_of(bytes(30), 1, 2)[:2], *ends]) == []
    assert assembler.broken.count == 1


def test_packets_after_a_pause_are_of_no_transfer() -> None:
    assembler = Assembler({GROUP})
    assert taken(assembler, frames_of(bytes(20)), step=1.01 * MAX_PAUSE) == []
    assert assembler.broken.count == 1


def test_another_group_and_a_transfer_that_began_before_are_neither_read_nor_counted() -> None:
    assembler = Assembler({GROUP})
    assert taken(assembler, [*frames_of(bytes(20), group=OTHER), *frames_of(bytes(20))[1:]]) == []
    assert assembler.broken.count == 0


@pytest.mark.parametrize("wrong", [bytes([BAM, 8, 0, 2]), bytes([BAM, 20, 0, 2]), bytes([BAM, 0xFA, 6, 255])])
def test_an_impossible_size_is_refused(wrong: bytes) -> None:
    announced, *packets = frames_of(bytes(20))
    assembler = Assembler({GROUP})
    assert taken(assembler, [(MANAGEMENT, announced[1], wrong + announced[2][4:]), *packets]) == []
