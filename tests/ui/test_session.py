"""What all pages show: state and order of the work, undo, refusals; nothing saved by itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rtid.diagnose.report import Diagnosis, FoundEffect, Value
from rtid.errors import RtidError
from rtid.project.added import AddedSection, ParameterSection
from rtid.tell.story import Story
from rtid.trace.glance import Curve
from rtid.ui.add_view import sentence
from rtid.ui.headline import strip
from rtid.ui.release_form import Released, ReleaseWish
from rtid.ui.sending import Sending, Way
from rtid.ui.shared import FAILED, LOADING, READY, ROLE, Session
from tests.replays import shared_replays  # noqa: F401

KEY = "internal_leakage_laminar", "a-b"
NAN = float("nan")


@dataclass
class FakeWorker:
    """Takes jobs; the test answers them."""

    jobs: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = field(default_factory=list)

    @property
    def is_busy(self) -> bool:
        return bool(self.jobs)

    def ask(self, method: str, *arguments: Any, **answers: Any) -> None:
        self.jobs.append((method, arguments, answers))

    def is_doing(self, *methods: str) -> bool:
        return bool(self.jobs) and self.jobs[0][0] in methods

    def forget(self, *methods: str) -> None:
        self.jobs = [job for job in self.jobs if job[0] not in methods]

    def answer(self, result: Any = None) -> str:
        method, _, answers = self.jobs.pop(0)
        answers["then"](result)
        return method

    def refuse(self, message: str) -> None:
        self.jobs.pop(0)[2]["failed"](RtidError(message, "do something else"))


def section() -> AddedSection:
    parameters = {"coefficient": ParameterSection(value=2e-12, sd=1e-14, unit="m3/s/Pa")}
    return AddedSection(effect=KEY[0], where=KEY[1], parameters=parameters)


def told(*named: tuple[str, str], alike: tuple[str, ...] = ()) -> Any:
    found = tuple(
        FoundEffect(
            e, w, alike, {"coefficient": Value(2e-12, 1e-14, "m3/s/Pa")}, 0.0, 90.0, 2e-6, 2e-7
        )
        for e, w in named
    )
    said = Diagnosis(
        "missing" if named else "matches", (), found, 100.0, 1.0, 2e-6, 2e-7, 1e-7, 1e-4, (1e9,),
        0.0, NAN, False, True, (), (), (),
    )  # fmt: skip
    return SimpleNamespace(diagnosis=said, ranking=())


def opened() -> Any:
    return SimpleNamespace(
        flow_unit="m3/s", look="first look", added=(), project="machine", trace="run.blf"
    )


def state(session: Session) -> str:
    return session.state


def can_stop(session: Session) -> bool:
    return session.can_stop


def named(session: Session) -> object:
    return session.named


def waiting(session: Session) -> Sending | None:
    return session.sending


def offered(session: Session) -> Released | None:
    return session.offered


def looks(session: Session) -> list[Any]:
    return [revision.look for revision in session.revisions]


def begun() -> tuple[Session, FakeWorker, list[str]]:
    worker, heard = FakeWorker(), list[str]()
    session = Session(Path("m.toml"), Path("run.blf"), worker)  # type: ignore[arg-type]
    session.listeners.append(heard.append)
    session.open()
    curves = (Curve("p_a", "Pa", np.zeros(2), np.ones(2)),)
    assert state(session) == LOADING and worker.answer(curves) == "read"
    assert session.curves == curves  # before anything is learned
    return session, worker, heard


def test_a_record_is_opened_diagnosed_and_the_next_step_is_made_ready() -> None:
    session, worker, heard = begun()
    assert state(session) == LOADING
    assert worker.answer(opened()) == "open"
    assert state(session) == READY
    assert "looks" in heard
    assert worker.answer(told(KEY)) == "diagnose"
    assert session.named == KEY
    assert [method for method, *_ in worker.jobs] == ["tried", "prepare"]
    worker.answer(addition())
    worker.answer()
    assert not worker.is_busy  # nothing is added or saved by itself


def test_a_record_that_cannot_be_read_says_why() -> None:
    session, worker, _ = begun()
    worker.refuse("run.blf: no complete sample")
    assert session.state == FAILED
    assert session.trouble == ("run.blf: no complete sample", "do something else")


def test_a_release_is_offered_of_the_model_that_is_shown_alone() -> None:
    session, worker, _ = begun()
    diagnosed(worker)
    released = Released((Path("run.map.dcm"),), (), ())
    session.release(ReleaseWish())
    assert worker.answer(released) == "release"
    assert offered(session) is released
    session.add(*KEY)
    worker.answer(addition())
    assert offered(session) is None  # its maps are of the model before
    worker.answer("second look")
    assert offered(session) is None
    worker.jobs.clear()
    session.release(ReleaseWish())
    worker.answer(released)
    assert offered(session) is released
    session.undo()
    assert offered(session) is None


def test_add_and_undo_leave_the_file_alone() -> None:
    session, worker, _ = begun()
    diagnosed(worker)
    session.add(*KEY)
    assert named(session) is None  # while it is being added nobody can add it twice
    assert worker.answer(addition()) == "add"
    assert worker.answer("second look") == "look"
    assert looks(session) == ["first look", "second look"]
    assert worker.answer(told()) == "diagnose"
    session.undo()
    assert looks(session) == ["first look"]  # before the worker knows of it
    assert worker.answer() == "back"
    assert session.named == KEY
    session.undo()
    assert not worker.is_busy  # there is nothing more to take back


def test_undo_after_save_takes_it_out_of_the_project_file() -> None:
    """It did nothing, and the page did not say so."""
    session, worker, _ = begun()
    diagnosed(worker)
    session.add(*KEY)
    for result in (addition(), "second look", told()):
        worker.answer(result)
    session.save()
    assert worker.answer(SimpleNamespace(note="wrote m.toml")) == "save"
    assert "Undo in the project" in strip(session)
    for _ in range(2):
        session.undo()  # clicked twice: there is one change to take back
        assert looks(session) == ["first look"]
    assert [method for method, *_ in worker.jobs] == ["take_back"]
    worker.refuse("m.toml has other effects than the page")
    assert looks(session) == ["first look", "second look"] and "other effects" in session.trouble[0]
    session.undo()
    worker.answer("wrote m.toml: as before the last change")
    assert (looks(session), session.note[:12]) == (["first look"], "wrote m.toml")


def addition(note: str = "") -> Any:
    return SimpleNamespace(sections=(section(),), section=section(), note=note)


def diagnosed(worker: FakeWorker) -> None:
    """The record is opened and diagnosed; nothing more is made ready."""
    for result in (opened(), told(KEY)):
        worker.answer(result)
    for _ in range(2):
        worker.refuse("no")


def test_what_is_fitted_is_added_at_once_and_can_be_shown_later() -> None:
    session, worker, heard = begun()
    for result in (opened(), told(KEY), addition()):
        worker.answer(result)
    assert worker.is_doing("prepare")
    heard.clear()
    session.add(*KEY)
    assert [method for method, *_ in worker.jobs] == ["prepare", "add", "look"]
    assert "Added" in strip(session) and set(heard) == {"state"}
    assert sentence(session).endswith("Its pictures follow once its maps are learned.")
    assert looks(session) == ["first look"] * 2 and len(session.seen) == 1
    session.save()
    assert len(worker.jobs) == 3, "what is not learned yet is not saved"
    for result in (None, addition(), "second look"):
        worker.answer(result)
    assert looks(session) == ["first look", "second look"] and "looks" in heard
    assert "Next: save, or undo" in sentence(session)
    assert worker.answer(told()) == "diagnose"


def test_what_is_not_fitted_yet_does_not_wait_for_more_than_the_fit() -> None:
    session, worker, _ = begun()
    for result in (opened(), told(KEY)):
        worker.answer(result)
    assert [method for method, *_ in worker.jobs] == ["tried", "prepare"]
    session.add(*KEY)
    assert [method for method, *_ in worker.jobs] == ["tried", "add"]


def test_what_cannot_be_shown_yet_is_taken_back_or_stopped_or_fails() -> None:
    for way in ("undo", "stop", "fails"):
        session, worker, _ = begun()
        for result in (opened(), told(KEY), addition(), None):
            worker.answer(result)
        session.add(*KEY)
        if way == "fails":
            worker.answer(addition())
            worker.refuse("the disk is full")
        else:
            session.undo() if way == "undo" else session.stop()
        assert looks(session) == ["first look"] and named(session) == KEY
        assert worker.jobs[-1][:2] == ("back", (1,))
        assert session.trouble[0] == ("the disk is full" if way == "fails" else "")


def test_what_is_undone_is_gone_while_the_worker_still_looks_at_it() -> None:
    session, worker, heard = begun()
    diagnosed(worker)
    session.add(*KEY)
    worker.answer(addition())
    worker.answer("second look")
    assert worker.is_doing("diagnose")
    heard.clear()
    session.undo()
    assert looks(session) == ["first look"] and heard == ["state", "looks"]
    assert [(method, arguments) for method, arguments, _ in worker.jobs] == [("back", (1,))]
    assert named(session) == KEY and session.doing == ""


def test_an_addition_that_is_being_made_is_stopped_by_undo() -> None:
    session, worker, _ = begun()
    diagnosed(worker)
    session.add(*KEY)
    session.undo()
    assert [method for method, *_ in worker.jobs] == ["back"]  # should it have been made meanwhile
    assert looks(session) == ["first look"] and named(session) == KEY


def test_a_diagnosis_that_is_stopped_may_be_asked_for_again() -> None:
    session, worker, _ = begun()
    worker.answer(opened())
    assert can_stop(session)
    session.stop()
    assert worker.answer() == "back" and not can_stop(session)
    assert "It was stopped" in strip(session) and 'data-do="diagnose"' in strip(session)
    session.diagnose()
    assert worker.answer(told(KEY)) == "diagnose"
    assert named(session) == KEY


def test_a_record_that_is_not_opened_after_all_may_be_opened_again() -> None:
    session, worker, _ = begun()
    session.stop()
    assert state(session) == FAILED and not worker.is_busy
    assert 'data-do="diagnose"' in strip(session)
    session.diagnose()
    assert state(session) == LOADING and worker.answer(()) == "read"


def test_what_is_written_cannot_be_stopped() -> None:
    session, worker, _ = begun()
    diagnosed(worker)
    session.save()
    session.stop()
    assert worker.answer(SimpleNamespace(note="wrote m.toml")) == "save"


def test_a_refusal_is_shown_and_the_work_goes_on() -> None:
    session, worker, heard = begun()
    diagnosed(worker)
    session.add("external_leakage_laminar", "a")
    worker.refuse("it does not lower the held-out error")
    assert session.trouble[0] == "it does not lower the held-out error"
    assert session.named == KEY
    assert heard[-1] == "state"


def test_of_a_set_none_is_offered_as_the_one() -> None:
    session, worker, _ = begun()
    worker.answer(opened())
    worker.answer(told(KEY, alike=("external_leakage_laminar (a)",)))
    assert session.named is None


def test_a_session_without_a_record_waits_for_nothing() -> None:
    worker = FakeWorker()
    session = Session(Path("m.toml"), None, worker)  # type: ignore[arg-type]
    session.open()
    assert session.state == READY
    assert not worker.is_busy


def test_what_speaks_against_a_change_stays_in_sight() -> None:
    session, worker, _ = begun()
    for result in (opened(), told(), None):
        if worker.is_busy:
            worker.answer(result)
    session.add(*KEY)
    note = "it does not lower the held-out error: 0.19 % without it, 0.20 % with it"
    worker.answer(addition(note))
    for _ in range(3):  # while the model is learned, and diagnosed, and behind it
        words = strip(session)
        assert "against the evidence" in words
        assert note in words
        assert 'data-do="undo"' in words
        if worker.is_busy:
            worker.answer(told())


def test_a_diagnosis_that_failed_is_not_waited_for() -> None:
    session, worker, _ = begun()
    worker.answer(opened())
    worker.refuse("diagnose failed: KeyError")
    words = strip(session)
    assert "Not diagnosed" in words
    assert "diagnose failed: KeyError. do something else" in words
    assert "Looking" not in words


def test_the_strip_says_what_to_do_next() -> None:
    session, worker, _ = begun()
    assert "Opening the record" in strip(session)
    worker.answer(opened())
    assert "Looking for what is missing" in strip(session)
    worker.answer(told(KEY))
    assert 'data-do="add" data-effect="internal_leakage_laminar"' in strip(session)
    for _ in range(2):
        worker.refuse("no")
    session.add(*KEY)
    worker.answer(addition())
    worker.answer("l")
    assert "Added" in strip(session)
    worker.answer(told())
    assert "The model matches" in strip(session)
    assert 'data-do="save"' in strip(session)


def writer(session: Session) -> int | None:
    return session.writer


def test_one_browser_works_and_the_others_follow() -> None:
    session, _, heard = begun()
    assert writer(session) is None
    for browser in (1, 2, 2):
        session.join(browser)
    assert (writer(session), len(session.pages)) == (1, 2)
    session.take_over(2)
    assert writer(session) == 2 and heard[-1] == ROLE
    session.leave(2)
    assert writer(session) == 2, "it has another page"
    session.leave(2)
    assert writer(session) == 1, "who followed works on"
    session.leave(1)
    assert writer(session) is None and not session.pages


def test_maps_are_sent_after_a_yes_to_what_would_change() -> None:
    worker = FakeWorker()
    session = Session(Path("m.toml"), None, worker, folder=Path("state"))  # type: ignore[arg-type]
    session.open()
    session.send()
    assert worker.jobs == []  # nothing was asked about
    session.foretell()
    assert worker.jobs[0][:2] == ("foretell", (Way(Path("m.toml"), Path("state")),))
    asked = Sending(Story("first", ()))
    worker.answer(asked)
    assert waiting(session) is asked and worker.jobs == []
    session.not_sent()
    session.send()
    assert waiting(session) is None and worker.jobs == []
    session.foretell()
    worker.answer(asked)
    session.send()
    session.send()  # pressed twice
    assert [job[:2] for job in worker.jobs] == [
        ("send", (Way(Path("m.toml"), Path("state")), asked))
    ]
    other = Sending(Story("what the controller says", ()))
    worker.answer(other)
    assert waiting(session) is other and session.note.startswith("nothing was sent")
    session.send()
    worker.answer("active: version 2")
    assert waiting(session) is None and session.note == "active: version 2"


def test_what_is_refused_is_not_sent_by_a_yes() -> None:
    worker = FakeWorker()
    session = Session(Path("m.toml"), None, worker)  # type: ignore[arg-type]
    for asked in (Sending(Story("", ()), ("too much",)), Sending(Story("", ()), is_same=True)):
        session.foretell()
        worker.answer(asked)
        session.send()
        assert worker.jobs == []
