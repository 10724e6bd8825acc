"""Answers in words for people."""

from featuredb.maps.lineage import lineage_text
from reloc.wire.query import InMapPose, LocaliseReply

# What a person can do about each reason.
ADVICE = {
    "NO_COVERAGE": "no map lies near the prior (or the database is empty): check the prior, "
    "or ingest photos of the place",
    "TOO_FEW_FEATURES": "the photo shows too little texture: take a sharper, lighter or wider one",
    "TOO_FEW_MATCHES": "the maps know little of what it shows: try a photo from a more similar viewpoint, "
    "a prior (--prior), or add photos of the place to the database",
    "TOO_FEW_INLIERS": "the matches do not agree on one pose: give a prior (--prior) or the camera "
    "(--camera), or take another photo",
    "AMBIGUOUS": "two different places explain it about equally well: give a prior (--prior)",
    "CONTRADICTS_PRIOR": "the photo fits a place far from the prior: check the prior or widen its sigma",
}


def describe(name: str, reply: LocaliseReply) -> str:
    """A few lines about one answer."""
    total = reply.timings_ms.get("total", 0.0)
    if reply.in_map is not None:
        return _in_map(name, reply, reply.in_map)
    if reply.utm is None or reply.position is None or reply.accuracy is None or reply.camera is None:
        advice = ADVICE.get(reply.reason or "", "")
        return (
            f"{name}: not localised: {reply.reason} ({reply.detail})\n"
            f"  {reply.inliers} inliers, {reply.matches} matches, {reply.features} features, {total:.0f} ms\n"
            f"{_contribution(reply)}"
            f"  try: {advice}\n"
        )
    utm, position, accuracy = reply.utm, reply.position, reply.accuracy
    return (
        f"{name}: localised, confidence {reply.confidence:.3f}\n"
        f"  UTM       EPSG:{utm.epsg}  E {utm.easting:.3f}  N {utm.northing:.3f}  "
        f"height {utm.height:.3f} m ({reply.height_datum})\n"
        f"  WGS84     {position.lat:.8f}, {position.lon:.8f}  h {position.h:.3f} m\n"
        f"  68 %      {accuracy.horizontal_68_m:.3f} m horizontally, "
        f"{accuracy.vertical_68_m:.3f} m vertically, {accuracy.orientation_68_deg:.3f} deg\n"
        f"  evidence  {reply.inliers} inliers from {reply.matches} matches, residual "
        f"{reply.residual_rms_px or 0.0:.2f} px, camera from {reply.camera.source}, "
        f"maps {', '.join(reply.maps)}\n"
        f"{_lineage(reply)}"
        f"{_contribution(reply)}"
        f"  time      {total:.0f} ms, snapshot {reply.snapshot}\n"
    )


def _in_map(name: str, reply: LocaliseReply, pose: InMapPose) -> str:
    """A pose in a map's own frame, worded so that nobody takes it for a place."""
    x, y, z = pose.center
    unit = "m" if pose.metric else "units of the map, not metres"
    return (
        f"{name}: found in map {pose.map_id}, which has NO PLACE ON EARTH, "
        f"confidence {reply.confidence:.3f}\n"
        f"  in map    x {x:.3f}  y {y:.3f}  z {z:.3f} {unit}; "
        f"z is {'up' if pose.upright else 'not known to be up'}\n"
        f"  evidence  {reply.inliers} inliers from {reply.matches} matches, residual "
        f"{pose.residual_rms_px:.2f} px, camera from {pose.camera.source}\n"
        f"  to place the map: featuredb maps says how\n"
        f"  time      {reply.timings_ms.get('total', 0.0):.0f} ms, snapshot {reply.snapshot}\n"
    )


def _lineage(reply: LocaliseReply) -> str:
    """What the first map, which most inliers lie on, stands on; nothing for an anchor of known place."""
    first = reply.lineage[0] if reply.lineage else None
    if first is None or (not first.steps and first.drift_m is None):
        return ""
    text = lineage_text(first.steps, first.anchors, first.drift_m, first.budget_m)
    return f"  lineage   {text}\n"


def _contribution(reply: LocaliseReply) -> str:
    said = reply.contribution
    if said is None:
        return ""
    if said.accepted:
        return f"  given     candidate {said.candidate_id}\n"
    return f"  not taken {said.reason}: {said.detail}\n"
