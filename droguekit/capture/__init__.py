"""Stereo pairs from cameras that run: devices, streams, video files played at their rate, and topics of ROS 2."""
