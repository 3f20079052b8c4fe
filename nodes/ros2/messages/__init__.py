"""ROS 2 messages: events become messages here, and messages become events.

Pure conversion: no node, no asyncio, no network, and no ROS needs to be installed. The ROS 2
bridge, the MCAP recorder, replays and viewers use it.

Read in this order: `topics` (names, quality of service, settings, frames), `typestore` (message
types, CDR and bags; the only import of rosbags), `mappings` (the table of all that becomes what),
`outgoing` and `incoming` (its functions), `images`, `paths` and `transforms` (which these use),
`publishing` (puts messages on topics).
"""
