"""Sends maps to the controller, whole or not at all: the sender of `download.md`.

It asks, waits, and asks again at most RETRIES times; chunks go in bursts, after each of which the
controller is asked for the chunk that it wants next; what is lost makes bursts shorter.  Nothing
here opens a bus: frames go through a `Link`, and only `firmware_bridge.playback` makes one that
reaches a wire.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from firmware_bridge import protocol
from firmware_bridge.lookup import crc32
from firmware_bridge.protocol import CHUNK, WORDS, Accepts, Held, Op, Reason

TIMEOUT_S = 0.1  # for an answer
RETRIES = 10  # times that something is asked without an answer, or without progress
RESTARTS = 4  # times that an image is begun
WINDOW = 32  # chunks per burst at most; less than half of the numbers that tell them apart
LEAST_WINDOW = 4
ANY = -1
IGNORED = 64  # answers to something else that one question puts up with

Progress = Callable[[int, int], None]


class DownloadError(RuntimeError):
    """The maps did not get there, and the controller's are as before; `remedy` says what to do.

    reason: what the controller refused it for, None where it did not answer.
    """

    exit_code = 3

    def __init__(self, message: str, remedy: str, reason: Reason | None = None) -> None:
        super().__init__(message)
        self.remedy, self.reason = remedy, reason


class UnconfirmedError(DownloadError):
    """The order to change maps was sent and not answered: the new or the old ones are active."""


class ContradictedError(DownloadError):
    """The controller said done, and what it holds is not what was sent."""


class Link(Protocol):
    """The way to a controller and back."""

    def tell(self, data: bytes) -> None:
        """Send one frame of eight bytes."""

    def hear(self, timeout_s: float) -> bytes | None:
        """The next answer; None after timeout_s without one."""


@dataclass(frozen=True)
class Image:
    """What is to be sent to a slot, as `lookup.image` and `lookup.numbers_image` make it."""

    data: bytes

    @property
    def chunks(self) -> int:
        """Number of DATA frames."""
        return -(-len(self.data) // CHUNK)

    @property
    def crc(self) -> int:
        """CRC-32 by which it is known."""
        return crc32(self.data)


class Session:
    """One conversation with the controller; nobody else gets one while it lasts."""

    def __init__(self, link: Link, session: int | None = None) -> None:
        self._link = link
        self._session = session or 1 + secrets.randbelow(0xFFFF)
        self.repeated = 0  # frames that were sent again
        self._probes = 0

    def open(self) -> Accepts:
        """Begin; DownloadError where nobody answers, another session is open, or it cannot be."""
        answer = self._ask([protocol.open_frame(self._session)], Op.OPEN, Op.ACCEPTS)
        if answer[1] != protocol.FORMAT:
            raise _refused(Reason.FORMAT)
        nodes, counts = (int.from_bytes(answer[k : k + 2], "little") for k in (3, 5))
        return Accepts(answer[1], answer[2], nodes, counts)

    def held(self, slot: int) -> Held:
        """What is active in a slot."""
        query = protocol.frame(self._session, Op.QUERY, bytes([slot]))
        version = self._ask([query], Op.QUERY, Op.HELD_VERSION, slot)
        crc = self._ask([query], Op.QUERY, Op.HELD_CRC, slot)
        return Held(*(int.from_bytes(a[2:6], "little") for a in (version, crc)))

    def flow(self, slot: int, u_v: float, dp_pa: float) -> tuple[float, int] | None:
        """What the active map of a slot gives, m3/s, and what it stands on; see `probe_frames`.

        None where the receiver does not answer: it is older than this question.
        """
        self._probes = (self._probes + 1) % protocol.PROBES
        frames = protocol.probe_frames(self._session, slot, self._probes, u_v, dp_pa)
        for _ in range(RETRIES):
            for data in frames:
                self._link.tell(data)
            for answer in self._answers():
                is_mine = answer[6] // protocol.PROBES == self._probes
                if answer[0] == Op.FLOW and answer[1] == slot and is_mine:
                    return protocol.flow_of(answer)
        return None

    def put(self, slot: int, image: Image, version: int, progress: Progress) -> None:
        """Send an image to the side of a slot that is not active; it stays there until `commit`."""
        for _ in range(RESTARTS):
            self._begin(slot, image, version)
            if self._transfer(slot, image, progress):
                end = protocol.frame(self._session, Op.END, bytes([slot]))
                reason = self._reply([end], slot)[0]
                if reason == Reason.DONE:
                    return
                if reason not in (Reason.WRONG_CRC, Reason.ORDER, Reason.INCOMPLETE):
                    raise _refused(reason)
            self.repeated += image.chunks
        raise _refused(Reason.WRONG_CRC)

    def commit(self, slots: list[int], version: int) -> None:
        """Make the images of these slots active, all at once."""
        try:
            reason = self._reply([protocol.commit_frame(self._session, slots, version)])[0]
        except DownloadError as error:
            if error.reason is None:
                raise UnconfirmedError(
                    "the controller does not say whether it has changed its maps",
                    "apply again: it will then say what it holds",
                ) from error
            raise
        if reason != Reason.DONE:
            raise _refused(reason)

    def close(self) -> None:
        """End; what was not committed is forgotten."""
        self._link.tell(protocol.frame(self._session, Op.CLOSE))

    def _begin(self, slot: int, image: Image, version: int) -> None:
        nu, ns = image.data[2:4]
        frames = protocol.begin_frames(
            self._session, slot, nu, ns, len(image.data), version, image.crc
        )
        for _ in range(RETRIES):
            reason = self._reply(frames, slot)[0]
            if reason == Reason.DONE:
                return
            if reason != Reason.ORDER:
                raise _refused(reason)
        raise _refused(Reason.ORDER)

    def _transfer(self, slot: int, image: Image, progress: Progress) -> bool:
        """Send all chunks; False where the controller has lost the beginning."""
        wanted, stuck, window = 0, 0, WINDOW
        poll = protocol.frame(self._session, Op.POLL, bytes([slot]))
        while wanted < image.chunks:
            end = min(wanted + window, image.chunks)
            for chunk in range(wanted, end):
                self._link.tell(protocol.data_frame(self._session, chunk, image.data))
            reason, now = self._reply([poll], slot)
            if reason != Reason.DONE or now > image.chunks:
                return False
            self.repeated += max(0, end - now)
            stuck = 0 if now > wanted else stuck + 1
            if stuck == RETRIES:
                raise DownloadError(
                    f"the controller has not taken chunk {now} of {image.chunks} in {stuck} tries",
                    "look after the bus, apply again; its maps are as before",
                )
            window = min(max(2 * (now - wanted), LEAST_WINDOW), WINDOW)
            wanted = max(wanted, now)
            progress(wanted, image.chunks)
        return True

    def _answers(self) -> Iterator[bytes]:
        """What comes in the session until nothing comes in time."""
        for _ in range(IGNORED):
            data = self._link.hear(TIMEOUT_S)
            if data is None:
                return
            if protocol.is_whole(self._session, data):
                yield data

    def _reply(self, frames: list[bytes], slot: int = 0) -> tuple[Reason, int]:
        """The reason of the REPLY to the last of these frames, and the chunk wanted next."""
        answer = self._ask(frames, frames[-1][0], Op.REPLY, slot)
        known = answer[3] in Reason.__members__.values()
        reason = Reason(answer[3]) if known else Reason.FORMAT
        return reason, int.from_bytes(answer[4:6], "little")

    def _ask(self, frames: list[bytes], asked: int, wanted: int, slot: int = ANY) -> bytes:
        """Send until the answer `wanted` comes; a REPLY to `asked` in its place is a refusal."""
        for _ in range(IGNORED):  # answers to what was asked before
            if self._link.hear(0.0) is None:
                break
        for attempt in range(RETRIES):
            self.repeated += len(frames) if attempt else 0
            for data in frames:
                self._link.tell(data)
            for answer in self._answers():
                is_reply = answer[0] == Op.REPLY and answer[1] == asked
                if is_reply and wanted != Op.REPLY and answer[3] in WORDS:
                    raise _refused(Reason(answer[3]))
                if wanted == Op.REPLY and is_reply and answer[2] == slot:
                    return answer
                if wanted != Op.REPLY and answer[0] == wanted and slot in (answer[1], ANY):
                    return answer
        raise DownloadError(
            f"the controller does not answer ({RETRIES} times {1e3 * TIMEOUT_S:.0f} ms)",
            "is it on, does it listen to publish.can_id, does it answer with publish.reply_id?",
        )


def _refused(reason: Reason) -> DownloadError:
    what, remedy = WORDS[reason]
    return DownloadError(f"the controller refuses: {what}", remedy, reason)


def download(
    session: Session,
    images: Mapping[int, Image],
    version: int,
    progress: Progress = lambda done, total: None,
) -> None:
    """All images by slot, then one change for all.  The session must be open."""
    total, before = sum(image.chunks for image in images.values()), 0
    for slot, image in images.items():
        sent = before
        session.put(slot, image, version, lambda done, _, sent=sent: progress(sent + done, total))  # type: ignore[misc]
        before += image.chunks
    session.commit(list(images), version)
