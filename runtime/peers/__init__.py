"""A run in several processes: each has some of the file's nodes, and events cross over.

    messages         what processes send each other
    zenoh_session    how it gets there: Zenoh, in this module only
    authentication   the secret of a run, and seals on messages
    shared_memory    what large events pass through between processes of one machine
    clock_sync       real time: keeping our clock with another machine's
    time_token       lockstep: one process at a time goes on, the one with the next thing due
    remote_events    outputs here with listeners there, and the other way round
    handshake        how two processes that see each other come to a session, and whether they fit
    member           another process: the way to it, and the difference of its clocks
    waiting          for other processes, and for the return of those that were lost
    membership       who is there, who comes and who goes
    joint            the start and the end, in order, without anybody left behind
    others           what a supervisor asks of them, of a run without any
    peers            all of it together, for the supervisor

An event that crosses is received once its sender's process has nothing more to do at that instant.
A handler that returns True ends the delivery in its own process only.
"""
