"""What node and commands endure: hours, damaged messages, kills, laps over DDS."""
