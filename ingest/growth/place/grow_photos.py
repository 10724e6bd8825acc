"""Reconstructions and lone photos of one round become maps, or say why not."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from ingest.colmap.bridge import Model
from ingest.growth.place.component import GrowOptions, grow_component
from ingest.growth.place.groups import GroupOptions, lone_groups
from ingest.growth.place.localised import with_shared_lenses
from ingest.growth.values import FeaturesOf, GrownMap, LocalisedPhoto, Refused
from ingest.map_builder import MapIdentity
from ingest.photos.cameras import shared_key
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowPhotosOptions:
    """Options of components and of groups of lone photos."""

    grow: GrowOptions = field(default_factory=GrowOptions)
    groups: GroupOptions = field(default_factory=GroupOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grown:
    """What became of the photos of one round.

    Attributes:
        maps: components first, then groups of lone photos.
        refused: components and groups that some gate refused.
        waiting: localised photos that no other one bears out, by row, with the reason.
    """

    maps: tuple[GrownMap, ...]
    refused: tuple[Refused, ...]
    waiting: dict[int, str]


def grow_photos(
    models: Sequence[Model],
    photos: Sequence[Photo],
    features_of: FeaturesOf,
    localised: Mapping[int, LocalisedPhoto],
    areas: Sequence[IndexedArea],
    identity: Callable[[tuple[int, ...]], MapIdentity],
    options: GrowPhotosOptions | None = None,
    known: Mapping[int, LocalisedPhoto] | None = None,
) -> Grown:
    """Place every model, then the localised photos that are in none of the placed ones.

    Args:
        models: of new photos, their rows are rows of `photos`; no photo is in two.
        localised: new photos that existing maps localise, by row.
        areas: of the active maps.
        identity: of the map of the photos with these rows.
        known: photos of existing maps whose features are at hand, localised again, by row of `photos`:
            they may bear out a lone photo, and then are part of its map too.
    """
    options = options or GrowPhotosOptions()
    maps: list[GrownMap] = []
    refused: list[Refused] = []
    taken: set[int] = set()
    for model in models:
        rows = tuple(int(r) for r in model.rows)
        outcome = grow_component(model, photos, features_of, localised, areas, identity(rows), options.grow)
        if isinstance(outcome, GrownMap):
            maps.append(outcome)
            taken |= set(rows)
        else:
            refused.append(outcome)
    alone = {r: photo for r, photo in {**(known or {}), **localised}.items() if r not in taken}
    keys = {r: shared_key(photos[r], "shared") for r in alone}
    one_lens = with_shared_lenses(alone, keys, options.grow.localise)
    lone = {r: photo for r, photo in one_lens.items() if r in localised}
    bystanders = {r: photo for r, photo in one_lens.items() if r not in localised}
    groups, waiting = lone_groups({**bystanders, **lone}, sorted(lone), features_of, options.groups)
    for group in groups:
        members = {r: p for r, p in {**bystanders, **lone}.items() if r in set(group.model.rows.tolist())}
        outcome = grow_component(
            group.model,
            photos,
            features_of,
            members,
            areas,
            identity(group.new),
            options.grow,
            needed=group.new,
        )
        if isinstance(outcome, GrownMap):
            maps.append(outcome)
        else:
            refused.append(outcome)
    return Grown(maps=tuple(maps), refused=tuple(refused), waiting=waiting)
