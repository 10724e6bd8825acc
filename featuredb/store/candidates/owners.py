"""Whose photos the maps are made of, and whose word counts: by identity, from the events of the inbox."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store.candidates.photos import by_candidate, read_events
from featuredb.store.candidates.states import ANONYMOUS, CONFIRMED, OPERATOR, USED, contributions_of, owner_of
from featuredb.store.database import Database
from featuredb.store.encode import Row
from featuredb.store.snapshot import Snapshot


@dataclass(frozen=True, slots=True, kw_only=True)
class Owners:
    """Owners of the images of maps, and what they are known by.

    Attributes:
        givers: who gave each contributed photo first since it was last withdrawn, by candidate id.
        made_of: candidate ids of the photos that each map was made of, by map id.
        anchors: ids of the active maps that measured their own place.
        on_record: owners of whom something was confirmed by more than the word of strangers: a photo in an
            anchor, or a photo noted as confirmed (`mark_confirmed`) of a map that is active now. ANONYMOUS
            never is: anybody is.
    """

    givers: Mapping[str, str] = field(default_factory=dict)
    made_of: Mapping[str, Set[str]] = field(default_factory=dict)
    anchors: Set[str] = frozenset()
    on_record: Set[str] = frozenset()

    def of_image(self, feature_map: FeatureMap, image: MapImage) -> str:
        """Who gave the photo; OPERATOR for one that did not come to the map from the inbox."""
        candidate_id = image.sha256[:32]
        if candidate_id not in self.made_of.get(feature_map.map_id, frozenset()):
            return OPERATOR
        return self.givers.get(candidate_id, ANONYMOUS)

    def of_map(self, feature_map: FeatureMap) -> list[str]:
        """`of_image` of all images of a map."""
        return [self.of_image(feature_map, image) for image in feature_map.images]


def read_owners(database: Database, snapshot: Snapshot) -> Owners:
    """The owners as of now; `snapshot` says which maps are active.

    Raises:
        StoreError: the events cannot be read.
    """
    active = {m.map_id: m for m in snapshot.maps() if m.status == "active"}
    anchors = frozenset(map_id for map_id, summary in active.items() if not summary.parents)
    givers: dict[str, str] = {}
    made_of: dict[str, set[str]] = {}
    on_record: set[str] = set()
    for candidate_id, events in by_candidate(read_events(database)).items():
        givers[candidate_id] = _giver(events)
        for k, event in enumerate(events):
            kind, map_id = event["event"], event["map_id"]
            if kind == USED:
                made_of.setdefault(map_id, set()).add(candidate_id)
            # The record is of whose photo it was then: who gives a withdrawn one again has not earned it.
            if (kind == USED and map_id in anchors) or (kind == CONFIRMED and map_id in active):
                on_record.add(_giver(events[:k]))
    return Owners(
        givers=givers, made_of=made_of, anchors=anchors, on_record=frozenset(on_record - {ANONYMOUS})
    )


def _giver(events: Sequence[Row]) -> str:
    given = contributions_of(events)
    return owner_of(given[0]) if given else ANONYMOUS
