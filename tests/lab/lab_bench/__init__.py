"""A lab's own package: a rig whose faults can be chosen, and a procedure that is quick."""
