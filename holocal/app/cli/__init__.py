"""The command line: one file per command, heavy imports inside the commands.

==============  ==========================================================
main            the application, and the one place where errors end
options         options that several commands share
run, resume     measure; go on
accept          put a result in force, or the one before
check           measure what is in force again: holds, or drifted
report, show, verify   read what was done
export                 a run for other programs
history, compare       runs in time; two of them side by side
tolerance       what built benches will be worth
render, capture        scene -> frame -> picture
detect_grid            the grid of dots in a photograph
rigs, procedures, doctor   what there is, and whether it works
==============  ==========================================================
"""
