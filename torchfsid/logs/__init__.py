"""Recorded logs from CSV, Parquet and ROS bags, read as measurements."""
