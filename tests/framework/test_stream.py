"""Streams over channels that drop, repeat and reorder: every item once, in order, with bounded memory."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fls_flow.links.stream import Packet, Receiver, Sender

# What happens next: the sender sends; a packet or answer on its way arrives, is lost or is repeated (the
# number picks which); the channel is cut, all on its way lost, and comes back; time passes.
EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["send", "arrive", "lose", "repeat", "cut", "back", "tick"]), st.integers(0, 9)
    ),
    max_size=150,
)
WINDOW = 6


class Channel:
    """One sender and its receivers, with everything on its way in two lists that the test picks from."""

    def __init__(self, receivers: int, ahead: int = 64, patience_s: float = 1e9) -> None:
        self.packets: list[tuple[str, Packet]] = []
        self.answers: list[tuple[str, tuple[str, int, int]]] = []
        self.got: dict[str, list[tuple[object, ...]]] = {f"r{n}": [] for n in range(receivers)}
        self.receivers = {
            name: Receiver(lambda packet, got=got: got.append((*packet.header, packet.payload)), ahead)
            for name, got in self.got.items()
        }
        self.sender = Sender(self.put, self.receivers, patience_s)
        self.sent: list[tuple[object, ...]] = []
        self.cut = False

    def put(self, packet: Packet) -> None:
        if not self.cut:
            self.packets += [(name, packet) for name in self.receivers]

    def send(self) -> None:
        number = len(self.sent)
        self.sent.append((number, b"%d" % number))
        self.sender.send((number,), b"%d" % number)

    def arrive(self, which: int) -> None:
        """A packet arrives, and what the receiver answers goes on its way; or an answer arrives."""
        if which % 2 and self.answers:
            name, (word, first, last) = self.answers.pop(which % len(self.answers))
            if word == "has":
                self.sender.acknowledged(name, last)
            else:
                self.sender.resend(first, last)
        elif self.packets:
            name, packet = self.packets.pop(which % len(self.packets))
            gap = self.receivers[name].take(packet)
            if not self.cut:
                self.answers.append((name, ("has", 0, self.receivers[name].expected - 1)))
                if gap is not None:
                    self.answers.append((name, ("gap", *gap)))

    def disturb(self, event: str, which: int) -> None:
        on_its_way = self.answers if which % 2 else self.packets
        if event == "lose" and on_its_way:
            del on_its_way[which % len(on_its_way)]
        elif event == "repeat" and on_its_way:
            on_its_way.insert(0, on_its_way[which % len(on_its_way)])
        elif event == "cut":
            self.cut = True
            self.packets.clear()
            self.answers.clear()
        elif event == "back":
            self.cut = False
            self.sender.resend()

    def in_flight(self) -> int:
        return len(self.sent) - min(map(len, self.got.values()))

    def settle(self) -> None:
        """The channel is whole from now on, and time passes."""
        self.disturb("back", 0)
        for _ in range(50):
            self.sender.tick()
            while self.packets:
                self.arrive(0)
            while self.answers:
                self.arrive(1)


@given(events=EVENTS, receivers=st.integers(1, 3), ahead=st.sampled_from([1, 3, 64]))
@settings(max_examples=400, deadline=None)
def test_every_item_arrives_once_and_in_order_whatever_the_channel_does(events, receivers, ahead):
    channel = Channel(receivers, ahead)
    for event, which in events:
        if event == "send" and channel.in_flight() < WINDOW:
            channel.send()
        elif event == "arrive":
            channel.arrive(which)
        elif event == "tick":
            channel.sender.tick()
        else:
            channel.disturb(event, which)
        for name, got in channel.got.items():
            assert got == channel.sent[: len(got)], name
            assert len(channel.receivers[name]._early) <= ahead
        assert len(channel.sender._waiting) <= WINDOW + 1 + len(channel.answers)
    channel.settle()
    assert all(got == channel.sent for got in channel.got.values())
    assert channel.sender.idle


@given(lost=st.sets(st.integers(0, 19), max_size=20))
@settings(max_examples=100, deadline=None)
def test_patience_alone_brings_back_what_a_silent_channel_lost(lost):
    channel = Channel(2, patience_s=0.0)
    for _ in range(20):
        channel.send()
    channel.packets = [(name, packet) for name, packet in channel.packets if packet.number not in lost]
    for _ in range(3):
        channel.sender.tick()
        while channel.packets:
            channel.arrive(0)
        channel.answers = [one for one in channel.answers if one[1][0] == "has"]  # no gap is reported either
        while channel.answers:
            channel.arrive(1)
    assert all(got == channel.sent for got in channel.got.values())
    assert channel.sender.idle


def received(numbers: list[int], ahead: int = 64) -> tuple[list[int], list[tuple[int, int] | None]]:
    """What is delivered and what is asked for, when packets of these numbers arrive."""
    got: list[int] = []
    receiver = Receiver(lambda packet: got.append(packet.number), ahead)
    return got, [receiver.take(Packet(number, ())) for number in numbers]


def test_a_gap_is_asked_for_once_and_the_next_one_as_soon_as_it_shows():
    got, asked = received([0, 2, 3, 5, 1, 4])
    assert asked == [None, (1, 1), None, None, (4, 4), None]
    assert got == [0, 1, 2, 3, 4, 5]


def test_what_is_too_far_ahead_is_dropped_and_asked_for_again():
    got, asked = received([5, 0, 1, 2, 3, 4, 5], ahead=2)
    assert asked[0] == (0, 4)
    assert got == [0, 1, 2, 3, 4, 5]


def test_repetitions_are_dropped():
    got, asked = received([0, 0, 1, 0, 1, 2, 2])
    assert (got, set(asked)) == ([0, 1, 2], {None})


def test_nothing_goes_out_again_while_answers_come():
    channel = Channel(1, patience_s=1e9)
    channel.send()
    channel.sender.tick()
    assert len(channel.packets) == 1


def test_a_packet_waits_for_the_slowest_receiver():
    sender = Sender(lambda packet: None, ["a", "b"])
    sender.send((0,))
    sender.send((1,))
    sender.acknowledged("a", 1)
    assert not sender.idle
    sender.acknowledged("b", 0)
    assert not sender.idle
    sender.acknowledged("b", 1)
    assert sender.idle


@pytest.mark.parametrize("answer", [("stranger", 5), ("a", -1)])
def test_answers_of_strangers_and_old_answers_change_nothing(answer):
    sender = Sender(lambda packet: None, ["a"])
    sender.send((0,))
    sender.acknowledged(*answer)
    assert not sender.idle


def test_who_reads_the_channel_never_waits_for_a_put_that_blocks():
    """Else two processes that put much to each other over a slow link would wait for each other for ever."""
    full, free = threading.Event(), threading.Event()

    def put(packet: Packet) -> None:
        if packet.number == 1:
            full.set()
            assert free.wait(30.0)

    sender = Sender(put, ["a"])
    sender.send((0,))
    writer = threading.Thread(target=sender.send, args=((1,),))
    writer.start()
    assert full.wait(30.0)
    reader = threading.Thread(target=lambda: (sender.acknowledged("a", 0), sender.resend(), sender.idle))
    reader.start()
    reader.join(30.0)
    assert not reader.is_alive()
    assert writer.is_alive()
    free.set()
    writer.join(30.0)
    sender.acknowledged("a", 1)
    assert sender.idle


def test_packets_of_many_threads_are_numbered_in_the_order_in_which_they_go_out():
    numbers: list[int] = []
    sender = Sender(lambda packet: numbers.append(packet.number), ["a"])
    threads = [threading.Thread(target=lambda: [sender.send((n,)) for n in range(300)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert numbers == list(range(1200))
