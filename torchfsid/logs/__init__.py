"""Logs that somebody recorded, from CSV, Parquet and ROS bags, as measurements."""
