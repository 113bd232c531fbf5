"""Cars on tracks: lines, speed profiles, a driver and the plant; makes measured-like laps as rosbag2 files."""
