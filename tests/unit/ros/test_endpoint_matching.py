"""run/links: when do all nodes of a graph know each other."""

import pytest

pytest.importorskip("wm_msgs.msg", reason="wm_msgs is not built")

from wm_nodes.ros.endpoint_matching import EndpointTable

TOPICS = {"/wm/environment": ({"image"}, {"credit"}), "/wm/recorder": ({"credit"}, {"image", "action"})}


class World:
    """Nodes that tell each other, and who has discovered whose end of which topic."""

    def __init__(self, *names: str) -> None:
        self.books = {name: EndpointTable(name) for name in names}
        self.readers: dict[str, set[tuple[str, bytes]]] = {}
        self.writers: dict[str, set[tuple[str, bytes]]] = {}
        self.active = dict.fromkeys(names, True)
        self.sessions = {name: 100 + i for i, name in enumerate(names)}

    def talk(self) -> None:
        for _ in range(3):
            for name, book in self.books.items():
                publishes, subscribes = TOPICS[name]
                book.refresh(
                    self.sessions[name], publishes, subscribes, self.active[name],
                    lambda topic: self.readers.get(topic, set()), lambda topic: self.writers.get(topic, set()),
                )
                for other in self.books.values():
                    other.note(book.announcement())

    def discover(self) -> None:
        for name, session in self.sessions.items():
            publishes, subscribes = TOPICS[name]
            for topic in publishes:
                self.writers.setdefault(topic, set()).add((name, bytes([session])))
            for topic in subscribes:
                self.readers.setdefault(topic, set()).add((name, bytes([session])))


@pytest.fixture
def world() -> World:
    return World(*TOPICS)


def test_data_may_flow_only_when_both_ends_of_every_shared_topic_are_known(world: World) -> None:
    book = world.books["/wm/environment"]
    world.talk()
    assert book.missing() == ["/wm/environment has not matched /wm/recorder",
                              "/wm/recorder has not matched /wm/environment"]
    world.readers["image"] = {("/wm/recorder", b"")}
    world.talk()
    assert len(book.missing()) == 2
    world.discover()
    world.talk()
    assert book.missing(["/wm/recorder"]) == []


def test_an_awaited_node_must_be_heard_and_active(world: World) -> None:
    book = world.books["/wm/environment"]
    world.discover()
    world.active["/wm/recorder"] = False
    assert book.missing(["/wm/recorder"]) == ["/wm/recorder has not been heard"]
    world.talk()
    assert book.missing() == []
    assert book.missing(["/wm/recorder"]) == ["/wm/recorder is not active"]
    world.active["/wm/recorder"] = True
    world.talk()
    assert book.missing(["/wm/recorder"]) == []


@pytest.mark.parametrize("lost", [False, True])
def test_a_node_that_left_is_not_waited_for_a_lost_one_is_and_a_restarted_one_is_matched_anew(
    world: World, lost: bool
) -> None:
    book = world.books["/wm/environment"]
    world.discover()
    world.talk()
    book.forget("/wm/recorder", lost=lost)
    assert book.missing(["/wm/recorder"]) == (["/wm/recorder is lost"] if lost else [])
    assert book.missing() == []
    world.readers["image"] = set()
    world.books["/wm/recorder"] = EndpointTable("/wm/recorder")
    world.sessions["/wm/recorder"] = 9
    world.talk()
    assert "/wm/environment has not matched /wm/recorder" in book.missing()
    world.discover()
    world.talk()
    assert book.missing(["/wm/recorder"]) == []


def test_a_node_configured_again_is_not_taken_for_matched_by_its_ends_of_before(world: World) -> None:
    book = world.books["/wm/environment"]
    world.discover()
    world.talk()
    assert book.missing() == []
    world.sessions["/wm/recorder"] = 9  # its subscriptions are made anew, and discovery still lists those of before
    world.talk()
    assert book.missing() == ["/wm/environment has not matched /wm/recorder"]
    world.discover()
    world.talk()
    assert book.missing() == []
