"""Tasks that workers import."""

import os
import time


def slowly(table, number):
    time.sleep(0.2)
    return number + float(table.sum())


def end_process(number):
    os._exit(3)
