"""MCAP files, for the recorder and for replays: ROS 2 messages, and events as they are.

Read in this order: `mcap_file` (writes and reads files), `native` (what stands in them; the only
import of mcap), `layout` (the bytes of files that may be torn, and a disk that may be full).
"""
