"""Recordings of ROS 2 and Foxglove: files of MCAP, and bag folders with MCAP or SQLite in them."""
