"""What several rows say: folders, photos, figures and their words."""

HELD_OUT = "DJI_0020.JPG DJI_0025.JPG DJI_0030.JPG DJI_0033.JPG"
BRIGHTON = "{data}/brighton/images"
SCAN = "{data}/brighton/model.laz"
ON_SCAN = f"--photos {BRIGHTON} --scan {SCAN} --poses {{cache}}/brighton-scan-poses.json"
# Of all 18 photos, by bundle adjustment.
BRIGHTON_LENS = "SIMPLE_RADIAL:2916.2,2011.0,1153.6,0.02"
OUT = "--json {work}/figures.json"
ANSWERS = "{answered} of {asked} answered, median {median_m:.2f} m and {median_deg:.2f} degrees"
ERRORS = "asked answered median_m largest_m median_deg largest_deg"
