"""One run in several processes: each has some of the file's nodes, and what they say crosses.

    messages   what processes say to each other
    session    how it gets there: Zenoh, in this module only
    secret     who may take part: those who know it
    seal       seals on messages, so that nobody else's are heard
    memory     what large events pass through between processes of one machine
    line       a thread that writes to one process, so that the loop never waits for a network
    meeting    who is there: nodes, equal files, and what is missing
    offsets    how far another machine's clocks are from ours
    following  real time: keeping our clock with another machine's
    turns      lockstep: one process at a time goes on, the one with the next thing due
    crossing   outputs here that are heard there, and the other way round
    greeting   how two processes that see each other come to a session
    membership     who is there, who comes and who goes
    member     one of them, and what is known of it
    ending     the end: in order, and nobody leaves before all know what each has to say
    peers      all of it together, for the supervisor

An event that crosses is heard once its sender's process has nothing more to do at that instant.
A handler that returns True ends the delivery in its own process only.
"""
