"""One run in several processes: each has some of the file's nodes, and events cross.

    messages         what processes send each other
    zenoh_session    how it gets there: Zenoh, in this module only
    secret           which processes may take part: those that know it
    authentication   seals on messages, so that no other process's are taken
    shared_memory    what large events pass through between processes of one machine
    outbox           a thread that writes to one process, so that the loop never waits for a network
    compatibility    whether the processes present make up the run: all nodes once, and equal files
    clock_offsets    how far another machine's clocks are from ours
    clock_sync       real time: keeping our clock with another machine's
    time_token       lockstep: one process at a time goes on, the one with the next thing due
    remote_events    outputs here with listeners there, and the other way round
    handshake        how two processes that see each other come to a session
    member           another process, and what is known of it
    waiting          for other processes, and for the return of those that were lost
    membership       who is there, who comes and who goes
    joint_shutdown   the end: in order, and no process leaves before all summaries are exchanged
    peers            all of it together, for the supervisor

An event that crosses is received once its sender's process has nothing more to do at that instant.
A handler that returns True ends the delivery in its own process only.
"""
