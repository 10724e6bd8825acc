"""Growing beyond the anchors: photos are placed by the maps that exist, behind gates."""
