"""Recordings of ROS 2: files of MCAP, and bag folders with MCAP or SQLite in them."""
