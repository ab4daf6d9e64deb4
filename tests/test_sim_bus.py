"""The simulated controller: frames decode to the samples, stamps survive, pace is kept."""

from collections.abc import Iterator

import can
import cantools
import numpy as np
import pytest

from firmware_bridge.catalog import CONTROLLER_DBC, Catalog, load
from firmware_bridge.frames import Frames, from_messages, to_messages
from firmware_bridge.playback import SendError, send
from rtid.sim.bus import open_test_bus, run_frames
from rtid.sim.frames import (
    ARBITRATION_US,
    CONTROLLER_ROUTES,
    FRAME_US,
    TASK_JITTER,
    Task,
    cycle_frames,
    multirate_frames,
)
from rtid.sim.run import Run, simulate
from rtid.sim.simulated_plant import SimulatedPlant

N = 20_000
T_US = 1000 * np.arange(N, dtype=np.int64)


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load()


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(SimulatedPlant(), "sweep", duration_s=0.5)


def ramps() -> dict[str, np.ndarray]:
    """Columns whose value tells the time at which they were read."""
    t = T_US * 1e-6
    steps = np.where(np.arange(N) % 2, 5.0, -5.0)
    columns = {name: 1e5 + 1e5 * t for name in ("p_a", "p_b", "p_supply", "p_tank")}
    return columns | {"u": steps, "x_ref": 0.01 * t, "x": 0.01 * t, "v": 0.01 * t}


def decoded(frames: Frames, message: str, signal: str) -> tuple[np.ndarray, np.ndarray]:
    catalog = load()
    mine = frames[frames.can_id == catalog.can_id(message)]
    return mine.t_us, catalog.layouts(message, [signal]).decode(mine.data)[:, 0]


def test_the_frames_hold_the_samples_exactly(run: Run) -> None:
    frames = run_frames(run)
    assert len(frames) == 3 * len(run.samples)
    for name in run.samples.names:
        route = CONTROLLER_ROUTES[name]
        t_us, values = decoded(frames, route.message, route.signal)
        assert np.array_equal(t_us, run.samples.t_us)
        assert np.allclose(values, run.samples.column(name), rtol=1e-12, atol=1e-12)


def test_counter_and_crc_are_those_of_the_dbc(run: Run) -> None:
    """cantools, which knows nothing of our encoder, reads them; the CRC is computed anew."""
    frames = run_frames(run)
    database = cantools.database.load_file(str(CONTROLLER_DBC))
    for k in range(0, 90):
        payload = bytes(frames.data[k])
        message = database.get_message_by_frame_id(int(frames.can_id[k]))  # type: ignore[union-attr]
        values = message.decode(payload)
        assert isinstance(values, dict)
        assert values["AliveCounter"] == (k // 3) % 16
        assert message.dbc is not None
        data_id = int(message.dbc.attributes["E2EDataId"].value)
        assert values["Crc"] == j1850(data_id.to_bytes(2, "little") + payload[1:])


def j1850(octets: bytes) -> int:
    """CRC-8 SAE J1850, start and XOR value 0, bit by bit."""
    crc = 0
    for octet in octets:
        crc ^= octet
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc


def test_jitter_of_a_cycle_stays_within_its_place(catalog: Catalog) -> None:
    rng = np.random.default_rng(1)
    frames = cycle_frames(catalog, CONTROLLER_ROUTES, ramps(), T_US, rng)
    for place, message in enumerate(("ValveCommand", "Pressures", "Motion")):
        late = frames.t_us[frames.can_id == catalog.can_id(message)] - T_US - place * FRAME_US
        assert late.min() >= 0 and late.max() <= FRAME_US // 2
        assert 10 < late.mean() < 25
    assert (np.diff(frames.t_us) >= 0).all()


def test_multirate_values_are_as_old_as_declared(catalog: Catalog) -> None:
    rng = np.random.default_rng(2)
    tasks = {
        "Pressures": Task(200.0, 0.003),
        "Motion": Task(50.0, 0.0),
        "ValveCommand": Task(100, 0),
    }
    frames = multirate_frames(catalog, CONTROLLER_ROUTES, ramps(), T_US, tasks, rng)
    t_us, p_a = decoded(frames, "Pressures", "PA")
    age_us = t_us - (p_a - 1e5) * 10
    quantum_us = 152.6 / 1e5 * 1e6  # one count of pressure on the ramp
    assert age_us.min() > 3000 - quantum_us
    assert age_us.max() < 3000 + ARBITRATION_US + quantum_us
    assert len(t_us) == pytest.approx(20 * 200, abs=2)
    t_us, x = decoded(frames, "Motion", "X")
    assert np.mean(t_us - x * 1e8) == pytest.approx(ARBITRATION_US / 2, abs=30)


def test_multirate_commands_are_held(catalog: Catalog) -> None:
    rng = np.random.default_rng(3)
    tasks = {"ValveCommand": Task(100.0, 0.0)}
    frames = multirate_frames(catalog, CONTROLLER_ROUTES, ramps(), T_US, tasks, rng)
    _, u = decoded(frames, "ValveCommand", "U")
    assert set(np.round(u, 3)) == {-5.0, 5.0}


def test_task_jitter_is_that_of_the_vehicle(catalog: Catalog) -> None:
    """50 ms message: 47.1 to 53.0 ms apart (1 to 99 %)."""
    rng = np.random.default_rng(4)
    tasks = {"Motion": Task(20.0, 0.0)}
    t_us = 1000 * np.arange(200_000, dtype=np.int64)
    columns = {"x": np.zeros(200_000), "v": np.zeros(200_000)}
    routes = {name: CONTROLLER_ROUTES[name] for name in columns}
    frames = multirate_frames(catalog, routes, columns, t_us, tasks, rng)
    low, high = np.percentile(np.diff(frames.t_us) / 1000, [1, 99])
    assert low == pytest.approx(47.05, abs=0.25) and high == pytest.approx(52.95, abs=0.25)
    assert pytest.approx(0.018, abs=5e-4) == TASK_JITTER


@pytest.fixture
def buses() -> Iterator[tuple[can.BusABC, can.BusABC]]:
    with (
        can.Bus("sim-bus", interface="virtual", preserve_timestamps=True) as sender,
        can.Bus("sim-bus", interface="virtual") as receiver,
    ):
        yield sender, receiver


def test_recorded_stamps_arrive(run: Run, buses: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = buses
    frames = run_frames(run)
    assert send(sender, to_messages(frames), float("inf")) == len(frames)
    received = from_messages(receiver.recv(0.0) for _ in range(len(frames)))  # type: ignore[misc]
    assert np.array_equal(received.t_us, frames.t_us)
    assert np.array_equal(received.data, frames.data)
    assert receiver.recv(0.0) is None


def test_pace(run: Run, buses: tuple[can.BusABC, can.BusABC]) -> None:
    """A clock that only sleep advances: 0.499 s at 4 x are 0.12475 s."""
    now = [100.0]

    def sleep(duration_s: float) -> None:
        now[0] += duration_s

    send(buses[0], to_messages(run_frames(run)), 4.0, clock_s=lambda: now[0], sleep=sleep)
    assert now[0] == pytest.approx(100.0 + 0.499 / 4, abs=1e-9)


def test_a_silly_speed_is_refused(buses: tuple[can.BusABC, can.BusABC]) -> None:
    with pytest.raises(SendError, match="must be > 0"):
        send(buses[0], [], 0.0)


def test_a_stalled_receiver_is_an_error_and_no_hang(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_bridge.playback.SEND_TIMEOUT_S", 0.01)
    with (
        can.Bus("full", interface="virtual", rx_queue_size=4),
        open_test_bus("virtual", "full") as sender,
        pytest.raises(SendError, match="after 4 frames"),
    ):
        send(sender, to_messages(run_frames(run)), float("inf"))


@pytest.mark.parametrize("interface", ["socketcan", "pcan", "slcan"])
def test_a_real_bus_is_refused(interface: str) -> None:
    with pytest.raises(SendError, match="must not speak here"):
        open_test_bus(interface, "can0")
