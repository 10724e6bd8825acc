"""Answers as other systems' messages: MAVLink for autopilots, ROS 2's in MCAP files, NMEA 0183."""
