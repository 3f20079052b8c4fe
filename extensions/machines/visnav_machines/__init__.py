"""A run in several processes: each has some of the file's nodes, and events cross over.

    messages         what processes send each other
    session          how it gets there: Zenoh, in this module only, and seals on messages
    member           another process: our clock beside its machine's, and the way out to it
    handshake        how two processes that see each other come to a session, and whether they fit
    membership       which processes are present, join and leave, and waiting for them
    time_token       lockstep: one process at a time runs, the one with the next thing due
    joint            the start and the end of the run, in order, in all processes
    peers            all of it together, for the supervisor, and the events that cross over

An event that crosses is received once its sender's process has nothing more to do at that instant.
A handler that returns True ends the delivery in its own process only.
"""
