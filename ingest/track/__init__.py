"""Films followed on a scan: landmarks by structure projection, keyframes registered to the scan."""
