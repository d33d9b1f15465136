"""``make torture``: does the library stay right when files, disks, processes and users do not?

Four parts, each counts its cases by what came of them (see ``report``):

files  mutated runs and files of every kind: loaded, played, described, resumed, converted
kills  trainings killed at random moments and resumed, compared with uninterrupted ones
disk   every write, sync, rename and opening of a training fails, one after another
code   hostile user code and environments (tests/hostile.py)

    python -m scripts.torture                                  all parts
    python -m scripts.torture files --count 100000 --seed 0    one part
    python -m scripts.torture files --seed 0 --case 1234       one case again, with all it says
"""
