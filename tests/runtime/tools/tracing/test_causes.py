"""Which event led to which."""

from __future__ import annotations

from runtime.tools.tracing.record import Causes, EventKind, EventNote, SentEvent

KINDS = {
    "Image": EventKind(measured=True, image=True, setpoint=False),
    "Imu": EventKind(measured=True, image=False, setpoint=False),
    "Pose": EventKind(measured=False, image=False, setpoint=False),
    "Setpoint": EventKind(measured=False, image=False, setpoint=True),
    "Note": EventKind(measured=False, image=False, setpoint=False),
}
HEARERS = {
    ("drone.images", "Image", "drone"): ("vo", "pilot"),
    ("drone.imu", "Imu", "drone"): ("vo", "pilot"),
    ("vo.poses", "Pose", "vo"): ("pilot", "drone"),
    ("pilot.setpoints", "Setpoint", "pilot"): ("drone",),
    ("drone.notes", "Note", "drone"): ("vo",),
}


class Story:
    """Tells events one by one."""

    def __init__(self) -> None:
        self.causes = Causes(KINDS, HEARERS)
        self.number = 0

    def __call__(self, sender: str, event: str, stamp: int, cause_id: int = 0) -> SentEvent:
        self.number += 1
        source = sender.partition(".")[0]
        number = self.number
        return self.causes.add(
            EventNote(number, number, sender, event, source, stamp, number, cause_id)
        )


def path(sent: SentEvent) -> list[tuple[str, str]]:
    return [(step.event, step.relation) for step in sent.path()]


def test_an_estimate_follows_from_the_image_whose_stamp_it_bears() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    tell("drone.images", "Image", 20)
    tell("drone.imu", "Imu", 20)
    sent = tell("vo.poses", "Pose", 10)
    assert path(sent) == [("Image", "begins"), ("Pose", "follows")]
    assert sent.path()[0].stamp == 10


def test_of_two_sensors_of_one_stamp_the_camera_counts() -> None:
    tell = Story()
    tell("drone.images", "Image", 20)
    tell("drone.imu", "Imu", 20)
    assert path(tell("vo.poses", "Pose", 20))[0] == ("Image", "begins")


def test_what_a_node_sends_on_hearing_an_event_follows_from_it() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    pose = tell("vo.poses", "Pose", 10)
    tell("drone.images", "Image", 20)
    sent = tell("pilot.setpoints", "Setpoint", 25, cause_id=2)
    assert sent.cause is pose
    assert path(sent) == [("Image", "begins"), ("Pose", "follows"), ("Setpoint", "follows")]


def test_what_a_node_sends_by_itself_holds_the_newest_of_a_camera() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    tell("vo.poses", "Pose", 10)
    tell("drone.imu", "Imu", 30)
    sent = tell("pilot.setpoints", "Setpoint", 30)  # the stamp of the IMU, by chance
    assert path(sent) == [("Image", "begins"), ("Pose", "follows"), ("Setpoint", "holds")]


def test_no_path_goes_on_behind_a_set_point_or_through_a_node_twice() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    tell("vo.poses", "Pose", 10)
    tell("pilot.setpoints", "Setpoint", 12, cause_id=2)
    assert tell("drone.notes", "Note", 13, cause_id=3).cause is None
    assert tell("vo.poses", "Pose", 99, cause_id=0).relation == "holds"


def test_a_sensor_begins_whatever_its_node_was_given() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    tell("vo.poses", "Pose", 10)
    assert path(tell("drone.images", "Image", 20, cause_id=2)) == [("Image", "begins")]


def test_without_a_sensor_there_is_no_path() -> None:
    assert Story()("pilot.setpoints", "Setpoint", 1).cause is None


def test_nothing_follows_from_what_its_node_does_not_hear() -> None:
    tell = Story()
    tell("drone.images", "Image", 10)
    tell("vo.poses", "Pose", 10)
    tell("drone.notes", "Note", 12, cause_id=2)
    sent = tell("pilot.setpoints", "Setpoint", 13, cause_id=3)  # which is vo's alone
    assert path(sent) == [("Image", "begins"), ("Pose", "follows"), ("Setpoint", "holds")]
