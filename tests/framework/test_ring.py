import json
import logging
import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from xxhash import xxh3_64_intdigest

from fls_flow import messages, wire
from fls_flow.errors import LinkError
from fls_flow.links._blocks import PAGE, Blocks, capacity_of
from fls_flow.links._shared_file import ENTRIES, TABLE_BYTES
from fls_flow.links.ring import MAX_READERS, SHARED_MEMORY, Arena, Descriptor, Window, domain, sweep
from fls_flow.testing.samples import sample_firings

STEADY = settings(derandomize=True, database=None, deadline=None)

# What a process of the tests does: one JSON request per line in, one answer per line out.
READER = """
    import json, sys
    from pathlib import Path
    from xxhash import xxh3_64_intdigest
    from fls_flow.links.ring import Descriptor, Window
    window, kept = Window(folder=Path(sys.argv[1])), {}
    for line in sys.stdin:
        verb, *rest = json.loads(line)
        if verb == "open":
            kept[rest[0][-1]] = window.open(Descriptor(*rest[0]), rest[1])
        if verb == "drop":
            del kept[rest[0]]
        print(json.dumps({key: xxh3_64_intdigest(view) for key, view in kept.items()}), flush=True)
"""
PRODUCER = """
    import json, sys
    from pathlib import Path
    from fls_flow.links.ring import Arena
    arena = Arena(sys.argv[2], folder=Path(sys.argv[1]))
    slot = arena.place(100_000, 1)
    slot.view[:] = bytes(range(250)) * 400
    print(json.dumps(slot.descriptor), flush=True)
    sys.stdin.readline()
"""
UNSTEADY_READER = """
    import json, random, sys
    from pathlib import Path
    from xxhash import xxh3_64_intdigest
    from fls_flow.links.ring import Descriptor, Window
    window, reader = Window(folder=Path(sys.argv[1])), int(sys.argv[2])
    draw, kept, seen = random.Random(reader), [], {"opened": 0, "checked": 0, "torn": 0}
    for line in sys.stdin:
        descriptor, digest = json.loads(line)
        if descriptor is None:
            break
        kept.append((window.open(Descriptor(*descriptor), reader), digest))
        seen["opened"] += 1
        for view, digest in kept:
            seen["checked"] += 1
            seen["torn"] += xxh3_64_intdigest(view) != digest
        while len(kept) > draw.randrange(8):
            del kept[draw.randrange(len(kept))]
        view = None
    kept.clear()
    print(json.dumps(seen), flush=True)
"""
OTHER_USER = """
    import json, os, resource, sys, uuid
    from fls_flow.errors import LinkError
    from fls_flow.links.ring import Arena, Descriptor, Window, domain, sweep
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
    found = {"changed": os.geteuid() == 0}
    if found["changed"]:
        os.setuid(65534)
    descriptor = Descriptor(*json.loads(sys.stdin.readline())[0])
    try:
        Window().open(descriptor, 0)
    except LinkError as error:
        found["error"] = str(error)
    if found["changed"]:
        found["swept"] = sweep(sys.argv[1])
    arena = Arena(f"fls-{uuid.uuid4().hex}")
    slot = arena.place(30_000_000, 1)
    slot.view[-1] = 7
    found["own"] = "works" if Window().open(slot.descriptor, 0)[-1] == 7 else "fails"
    arena.close()
    found["domain"] = domain()
    print(json.dumps(found), flush=True)
"""


class Child:
    """A fresh interpreter that answers each request with a line."""

    def __init__(self, script: str, *arguments: str | Path) -> None:
        command = [sys.executable, "-c", textwrap.dedent(script), *map(str, arguments)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise AssertionError(self.process.communicate()[1])
        return json.loads(line)

    def tell(self, *request: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def ask(self, *request: Any) -> Any:
        self.tell(*request)
        return self.answer()

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def end(self) -> tuple[int, str]:
        _, errors = self.process.communicate(timeout=60)
        return self.process.returncode, errors


Start = Callable[..., Child]


@pytest.fixture
def start() -> Iterator[Start]:
    children: list[Child] = []

    def started(script: str, *arguments: str | Path) -> Child:
        children.append(Child(script, *arguments))
        return children[-1]

    yield started
    for child in children:
        child.process.kill()
        child.process.communicate()


@pytest.fixture
def arena(tmp_path: Path) -> Iterator[Arena]:
    arena = Arena("fls-run-sonar", folder=tmp_path, max_bytes=8 << 20)
    yield arena
    arena.close()


@pytest.fixture
def window(tmp_path: Path) -> Window:
    return Window(folder=tmp_path)


def fill(slot: Any, seed: int) -> int:
    """Content that depends on the seed, and its checksum."""
    slot.view[:] = np.random.default_rng(seed).bytes(len(slot.view))
    return int(xxh3_64_intdigest(slot.view))


def test_opened_bytes_are_those_written_read_only_and_aligned(arena: Arena, window: Window) -> None:
    for size in (1, 63, 64, 4096, 4097, 78_000, 624_001):
        slot = arena.place(size, 0b1)
        assert slot is not None
        expected = fill(slot, size)
        array = window.open(slot.descriptor, 0)
        assert (array.dtype, array.shape) == (np.uint8, (size,))
        assert xxh3_64_intdigest(array) == expected
        assert array.ctypes.data % 64 == 0
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.flags.writeable = True


def test_descriptor_survives_json(arena: Arena, window: Window) -> None:
    slot = arena.place(10, 1)
    assert slot is not None
    fill(slot, 1)
    sent = Descriptor(*json.loads(json.dumps(slot.descriptor)))
    assert sent == slot.descriptor
    assert len(window.open(sent, 0)) == 10


@pytest.mark.parametrize(
    "view",
    [
        lambda array: array,
        lambda array: array[10:20],
        lambda array: array[:960].view(np.float32).reshape(2, 120).T,
        lambda array: memoryview(array)[3:5],
        lambda array: np.frombuffer(memoryview(array).cast("B"), np.int16, 4, 8)[1:],
        lambda array: np.asarray(array)[None].squeeze()[::2],
    ],
)
def test_lease_lasts_as_long_as_any_view(arena: Arena, window: Window, view: Any) -> None:
    slot = arena.place(1000, 1)
    assert slot is not None
    kept = view(window.open(slot.descriptor, 0))
    assert arena.leased() == 1
    del kept
    assert arena.leased() == 0


CLASSES = [
    cls
    for cls in (getattr(messages, name) for name in messages.__all__)
    if messages.is_message_type(cls) and cls is not messages.Message
]


def arrays_of(value: Any) -> Iterator[np.ndarray]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from arrays_of(part)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            yield from arrays_of(getattr(value, name))


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_message_is_decoded_in_place(arena: Arena, window: Window, cls: Any) -> None:
    message = sample(cls)
    layout = wire.layout(message)
    slot = arena.place(layout.size, 1)
    assert slot is not None
    layout.write_into(slot.view, checksum=False)
    array = window.open(slot.descriptor, 0)
    decoded = wire.decode(array.data, cls)
    assert wire.encode(decoded) == wire.encode(message)
    filled = [part for part in arrays_of(decoded) if part.size]
    assert filled or cls is messages.NavState
    assert all(np.shares_memory(part, array) for part in filled)
    assert not any(part.flags.writeable for part in filled)
    assert all(part.ctypes.data % 64 == 0 for part in filled)
    del array
    assert arena.leased() == (1 if filled else 0)
    del decoded, filled
    assert arena.leased() == 0


def sample(cls: Any) -> Any:
    """A made-up message of a class, with something in it."""

    @dataclass
    class Sink:
        def __call__(self, value: cls) -> None:
            """Take it."""

    Sink.__call__.__annotations__["value"] = cls
    return sample_firings(Sink)[1]["value"]


def test_slot_is_free_when_its_last_reader_has_released(arena: Arena, window: Window) -> None:
    slot = arena.place(5000, 0b1011)
    assert slot is not None
    first, last = window.open(slot.descriptor, 0), window.open(slot.descriptor, 3)
    assert np.shares_memory(first, last)
    del first
    window.release(slot.descriptor, 1)  # dropped unread
    assert arena.leased() == 1
    del last
    again = arena.place(5000, 1)
    assert again is not None
    assert again.descriptor[:3] == slot.descriptor[:3]
    assert again.descriptor.generation > slot.descriptor.generation


def test_producer_takes_a_lease_back_that_nobody_was_told_of(arena: Arena, window: Window) -> None:
    slot = arena.place(5000, 0b11)
    assert slot is not None
    slot.release(0)
    with pytest.raises(LinkError, match="not leased to reader 0"):
        window.open(slot.descriptor, 0)
    window.release(slot.descriptor, 1)
    again = arena.place(5000, 0b11)
    slot.release(0)  # too late: the slot is another message's
    assert again is not None
    assert arena.leased() == 1
    window.release(again.descriptor, 0)


def test_slow_reader_is_never_overwritten(arena: Arena, window: Window) -> None:
    kept = []
    while (slot := arena.place(300_000, 1)) is not None:
        kept.append((fill(slot, len(kept)), window.open(slot.descriptor, 0)))
    assert len(kept) == ((8 << 20) - TABLE_BYTES) // capacity_of(300_000)
    assert arena.allocated <= 8 << 20
    assert arena.place(1_000_000, 1) is None
    assert all(xxh3_64_intdigest(view) == digest for digest, view in kept)
    del kept[5]
    assert arena.place(300_000, 1) is not None
    assert arena.place(300_000, 1) is None
    assert all(xxh3_64_intdigest(view) == digest for digest, view in kept)


def test_room_of_small_messages_is_joined_for_a_large_one(arena: Arena, window: Window) -> None:
    kept = []
    while (slot := arena.place(100_000, 1)) is not None:
        kept.append(window.open(slot.descriptor, 0))
    random.Random(4).shuffle(kept)
    kept.clear()
    slot = arena.place(7_000_000, 1)
    assert slot is not None
    window.release(slot.descriptor, 0)
    assert arena.place(8 << 20, 1) is None  # more than there is in all


def test_messages_without_end_are_bounded_by_what_is_kept(arena: Arena, window: Window) -> None:
    kept: dict[int, tuple[int, Any]] = {}
    draw = random.Random(1)
    for number in range(4000):
        slot = arena.place(draw.choice([900, 5000, draw.randrange(1, 200_000)]), 1)
        assert slot is not None
        kept[number % 12] = fill(slot, number), window.open(slot.descriptor, 0)
        digest, view = kept[draw.choice([*kept])]
        assert xxh3_64_intdigest(view) == digest
    assert arena.allocated <= 8 << 20
    assert arena.leased() == len(kept)


def test_there_are_no_more_slots_than_entries(tmp_path: Path) -> None:
    arena = Arena("fls-many", folder=tmp_path)
    window = Window(folder=tmp_path)
    slots = [arena.place(1, 1) for _ in range(ENTRIES)]
    assert None not in slots
    assert arena.place(1, 1) is None
    assert slots[7] is not None
    window.release(slots[7].descriptor, 0)
    assert arena.place(5000, 1) is not None  # of another size
    arena.close()


def test_leases_that_are_not_there_are_refused(arena: Arena, window: Window, tmp_path: Path) -> None:
    slot = arena.place(5000, 0b1)
    assert slot is not None
    good = slot.descriptor
    (tmp_path / "fls-other").write_bytes(bytes(2 * TABLE_BYTES))
    (tmp_path / "fls-short").write_bytes(b"FLSRING1")
    (tmp_path / "fls-link").symlink_to(tmp_path / "fls-run-sonar")
    (tmp_path / "fls-folder").mkdir()
    for name in ("fls-gone", "fls-other", "fls-short", "fls-link", "fls-folder", "../x", "fls-/../y", "", 3):
        with pytest.raises(LinkError, match="cannot be opened"):
            window.open(good._replace(name=name), 0)
    for bad, reader in [
        (good, 1),
        (good, MAX_READERS),
        (good, -1),
        (good._replace(slot=ENTRIES), 0),
        (good._replace(slot=1), 0),
        (good._replace(generation=good.generation - 1), 0),
        (good._replace(offset=arena.allocated), 0),
        (good._replace(offset=0), 0),
        (good._replace(size=arena.allocated), 0),
        (good._replace(size=0), 0),
    ]:
        with pytest.raises(LinkError, match="shared memory fls-run-sonar"):
            window.open(bad, reader)
    view = window.open(good, 0)
    with pytest.raises(LinkError, match="not leased to reader 0"):
        window.open(good, 0)  # else the first view's death would free the slot under the second
    del view
    with pytest.raises(LinkError, match="not leased to reader 0"):
        window.open(good, 0)


def test_what_cannot_be_placed_is_refused(arena: Arena, tmp_path: Path) -> None:
    for size, readers in [(0, 1), (-1, 1), (10, 0), (10, -1), (10, 1 << MAX_READERS)]:
        with pytest.raises(ValueError, match=f"has {size} bytes"):
            arena.place(size, readers)
    for name in ("sonar", "fls-", "fls-a/b", "fls-../b", "fls-a b"):
        with pytest.raises(ValueError, match="it takes 'fls-'"):
            Arena(name, folder=tmp_path)
    with pytest.raises(ValueError, match="max_bytes is 4096"):
        Arena("fls-a", folder=tmp_path, max_bytes=4096)
    assert [*tmp_path.iterdir()] == []  # nothing is made before the first message


def test_views_outlive_arena_file_and_window(arena: Arena, window: Window, tmp_path: Path) -> None:
    slot = arena.place(50_000, 1)
    assert slot is not None
    digest = fill(slot, 3)
    view = window.open(slot.descriptor, 0)
    arena.close()
    arena.close()
    window.close()
    assert [*tmp_path.iterdir()] == []
    assert arena.place(50_000, 1) is None
    del slot
    assert xxh3_64_intdigest(view) == digest


def test_forgotten_file_is_unmapped_with_its_last_view(arena: Arena, window: Window, tmp_path: Path) -> None:
    def mapped() -> bool:
        open_files = [os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
        return str(tmp_path) in Path("/proc/self/maps").read_text() + "".join(open_files)

    slot = arena.place(50_000, 1)
    assert slot is not None
    view = window.open(slot.descriptor, 0)
    window.forget(slot.descriptor.name)
    arena.close()
    del slot
    assert mapped()
    del view
    assert not mapped()


def test_file_that_cannot_be_made_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "fls-taken").write_text("mine")
    for arena in (Arena("fls-a", folder=tmp_path / "nowhere"), Arena("fls-taken", folder=tmp_path)):
        caplog.clear()
        assert [arena.place(10, 1) for _ in range(3)] == [None] * 3
        assert [record.levelno for record in caplog.records] == [logging.WARNING]
        assert f"shared memory {arena._path} cannot be made" in caplog.text
        arena.close()
    assert (tmp_path / "fls-taken").read_text() == "mine"


def test_file_that_cannot_grow_keeps_what_it_has(
    arena: Arena, window: Window, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = arena.place(100_000, 1)
    assert first is not None
    assert arena._file is not None
    has = arena.allocated
    # Filling the memory of the machine would be the honest way; a file that is only readable cannot grow either.
    readable = os.open(tmp_path / arena.name, os.O_RDONLY)
    os.dup2(readable, arena._file.fd)
    os.close(readable)
    assert [arena.place(size, 1) for size in (200_000, 200_000, 100_000, 10)] == [None] * 4
    assert len(caplog.records) == 1
    assert "cannot grow to" in caplog.text
    assert arena.allocated == has
    window.release(first.descriptor, 0)
    slots = [arena.place(50_000, 1) for _ in range(3)]  # two fit where the large one was
    assert slots[2] is None
    for slot in slots[:2]:
        assert slot is not None
        assert fill(slot, 1) == xxh3_64_intdigest(window.open(slot.descriptor, 0))
    assert arena.allocated == has


def test_all_that_a_slot_covers_has_memory_behind_it(arena: Arena, tmp_path: Path) -> None:
    for size in (1, 5000, 300_000, 2_000_000):
        assert arena.place(size, 1) is not None
        assert (tmp_path / arena.name).stat().st_blocks * 512 >= arena.allocated
    assert arena.allocated > 2_305_001


def test_thousands_of_messages_to_two_processes_are_never_torn(start: Start) -> None:
    """In /dev/shm, every slot written again as soon as both have released it, while they read what they keep."""
    name = f"fls-{uuid.uuid4().hex}"
    arena = Arena(name, max_bytes=TABLE_BYTES + 12 * capacity_of(20_000))
    children = [start(UNSTEADY_READER, SHARED_MEMORY, reader) for reader in range(2)]
    refused, slots, messages = 0, set(), 4000
    try:
        for number in range(messages):
            while (slot := arena.place(20_000 - number % 100, 0b11)) is None:
                refused += 1
                time.sleep(0.0005)
            slots.add(slot.descriptor.slot)
            digest = fill(slot, number)
            for child in children:
                child.tell(slot.descriptor, digest)
        for child in children:
            child.tell(None, 0)
            seen = child.answer()
            assert seen["opened"] == messages
            assert seen["checked"] > 2 * messages
            assert seen["torn"] == 0
        assert refused > 0
        assert len(slots) == 12
        assert arena.leased() == 0
    finally:
        arena.close()
    assert not (SHARED_MEMORY / name).exists()


def test_fan_out_to_four_processes_costs_one_copy(arena: Arena, start: Start, tmp_path: Path) -> None:
    children = [start(READER, tmp_path) for _ in range(4)]
    for number in range(20):
        slot = arena.place(600_000, 0b1111)
        assert slot is not None
        digest = fill(slot, number)
        for reader, child in enumerate(children):
            assert child.ask("open", slot.descriptor, reader) == {str(slot.descriptor.generation): digest}
            assert arena.leased() == 1
            assert child.ask("drop", slot.descriptor.generation) == {}
        assert arena.leased() == 0
    assert arena.allocated == TABLE_BYTES + capacity_of(600_000)


def test_killed_reader_holds_its_slots_until_dropped(arena: Arena, start: Start, tmp_path: Path) -> None:
    child, window = start(READER, tmp_path), Window(folder=tmp_path)
    slots = [arena.place(5000, 0b11) for _ in range(3)]
    assert slots[0] is not None
    assert slots[2] is not None
    child.ask("open", slots[0].descriptor, 1)
    child.kill()
    window.release(slots[0].descriptor, 0)
    assert arena.leased() == 3
    arena.drop(1)
    assert arena.leased() == 2  # the other reader's leases stand
    assert len(window.open(slots[2].descriptor, 0)) == 5000


def test_reader_that_ends_with_views_says_nothing(arena: Arena, start: Start, tmp_path: Path) -> None:
    child = start(READER, tmp_path)
    slot = arena.place(5000, 1)
    assert slot is not None
    child.ask("open", slot.descriptor, 0)
    assert child.end() == (0, "")


def test_killed_producer_leaves_a_file_that_sweep_removes(start: Start, tmp_path: Path) -> None:
    window = Window(folder=tmp_path)
    names = ["fls-ab-sonar", "fls-ab-cfar", "fls-abc-sonar"]
    children = [start(PRODUCER, tmp_path, name) for name in names]
    descriptors = [Descriptor(*child.answer()) for child in children]
    views = [window.open(descriptors[0], 0)]
    children[0].kill()
    children[2].kill()
    assert sweep("fls-", folder=tmp_path, abandoned=True) == [
        "fls-abc-sonar"
    ]  # the others are mapped somewhere
    assert sweep("fls-ab-", folder=tmp_path) == ["fls-ab-cfar", "fls-ab-sonar"]
    assert [*tmp_path.iterdir()] == []
    assert bytes(views[0]) == bytes(range(250)) * 400
    with pytest.raises(LinkError, match="cannot be opened"):
        window.open(descriptors[1], 0)


def test_sweep_touches_nothing_else(tmp_path: Path) -> None:
    for name in ("fls-a-x", "fls-a-x y", "other-fls-a", "fls-b-x"):
        (tmp_path / name).touch()
    (tmp_path / "fls-a-link").symlink_to(tmp_path / "other-fls-a")
    (tmp_path / "fls-a-folder").mkdir()
    assert sweep("fls-a-", folder=tmp_path) == ["fls-a-x"]
    assert {path.name for path in tmp_path.iterdir()} == {
        "fls-a-x y", "other-fls-a", "fls-b-x", "fls-a-link", "fls-a-folder",
    }  # fmt: skip
    assert sweep("fls-", folder=tmp_path / "nowhere") == []
    for prefix in ("", "fls", "*", "../fls-"):
        with pytest.raises(ValueError, match="begin with 'fls-'"):
            sweep(prefix, folder=tmp_path)


def test_file_is_private_and_another_user_can_neither_open_nor_sweep_it(start: Start) -> None:
    arena = Arena(f"fls-{uuid.uuid4().hex}")
    try:
        slot = arena.place(5000, 0b11)
        assert slot is not None
        assert (SHARED_MEMORY / arena.name).stat().st_mode & 0o777 == 0o600
        found = start(OTHER_USER, arena.name).ask(slot.descriptor)
        assert found["own"] == "works"  # as an ordinary user who may lock no memory
        if found["changed"]:  # only root can become somebody else
            assert "cannot be opened" in found["error"]
            assert found["swept"] == []
            assert found["domain"] != domain()
            assert (SHARED_MEMORY / arena.name).exists()
    finally:
        arena.close()


def test_domain_tells_users_and_file_systems_apart(tmp_path: Path) -> None:
    assert domain() == domain() != ""
    assert domain(tmp_path / "nowhere") == ""
    assert domain(Path("/proc")) != domain()


def test_threads_share_an_arena_and_a_window(tmp_path: Path) -> None:
    """Four producing threads, two arenas at once; each message is checked by another thread after a while."""
    arenas = [Arena(f"fls-{side}", folder=tmp_path, max_bytes=2 << 20) for side in ("port", "starboard")]
    window, torn, sent = Window(folder=tmp_path), [], []

    def produce(seed: int) -> None:
        draw, kept = random.Random(seed), []
        for number in range(400):
            slot = arenas[seed % 2].place(draw.choice([500, 9000, 70_000]), 1)
            if slot is not None:
                digest = fill(slot, 1000 * seed + number)
                kept.append((digest, window.open(slot.descriptor, 0)))
                sent.append(slot.descriptor.generation)
            if len(kept) > 10 or slot is None:
                digest, view = kept.pop(draw.randrange(len(kept)))
                if xxh3_64_intdigest(view) != digest:
                    torn.append(seed)

    threads = [threading.Thread(target=produce, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torn == []
    assert len(sent) == 4 * 400
    assert [arena.leased() for arena in arenas] == [0, 0]
    for arena in arenas:
        arena.close()


@given(st.lists(st.integers(1, 1 << 40), max_size=20), st.integers(1, 1 << 40))
@STEADY
def test_capacity_is_whole_pages_and_little_more_than_the_size(sizes: list[int], size: int) -> None:
    capacity = capacity_of(size)
    assert capacity % PAGE == 0
    assert size <= capacity <= max(size + PAGE, size * 1.125 + 1)
    assert capacity_of(capacity) == capacity
    assert [*map(capacity_of, sorted(sizes))] == sorted(map(capacity_of, sizes))


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 30)), max_size=120), st.integers(10, 60))
@STEADY
def test_blocks_never_overlap_and_none_is_lost(steps: list[tuple[int, int]], pages: int) -> None:
    """Against the plain way: a page belongs to one block, and what no block has can be had."""
    blocks, held = Blocks(PAGE, PAGE * (1 + pages)), []
    for size, victim in steps:
        capacity = size * PAGE
        offset = blocks.reuse(capacity) or blocks.carve(capacity)
        if offset is None:
            blocks.join()
            offset = blocks.fit(capacity) or blocks.carve(capacity)
        if offset is None:
            taken = {page for at, has in held for page in range(at // PAGE, (at + has) // PAGE)}
            free = "".join("x" if page in taken else "." for page in range(1, 1 + pages))
            assert "." * size not in free
        else:
            assert PAGE <= offset <= PAGE * (1 + pages) - capacity
            assert all(offset + capacity <= at or at + has <= offset for at, has in held)
            held.append((offset, capacity))
        if victim < len(held):
            blocks.give(*held.pop(victim))
    for block in held:
        blocks.give(*block)
    blocks.join()
    assert blocks.carve(pages * PAGE) == PAGE
