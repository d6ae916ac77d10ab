"""Reads registers as numbers, prints what config/kits/python/beltgauge.py (its folder is the argument) makes of them."""
import sys
from types import ModuleType

registers = [int(number) for number in sys.stdin.read().split()]


class Client:
    """In place of pymodbus, which is not needed here: answers with the registers."""

    def __init__(self, host, **_):
        self.connected = False

    def connect(self):
        self.connected = True
        return True

    def read_holding_registers(self, address, count):
        return type("Answer", (), {"registers": registers[address : address + count], "isError": lambda self: False})()


for name, member, value in (
    ("pymodbus", "client", None),
    ("pymodbus.client", "ModbusTcpClient", Client),
    ("pymodbus.exceptions", "ModbusException", Exception),
):
    sys.modules[name] = ModuleType(name)
    setattr(sys.modules[name], member, value)
sys.path.insert(0, sys.argv[1])
sys.dont_write_bytecode = True

import beltgauge as kit

gauge = kit.Beltgauge("nowhere")
try:
    status, parcel = gauge.status(), gauge.waiting()
except kit.BeltgaugeError:
    print("is_known 0")
    sys.exit()
told = {
    "is_known": True,
    "running": kit.StatusBit.RUNNING in status.status,
    "is_whole": parcel.is_whole,
    "may_be_used": parcel.may_be_used,
    "is_box": parcel.is_box,
    "by_encoder": kit.Valid.BY_ENCODER in parcel.valid,
    "clipped": kit.Flag.CLIPPED in parcel.flags,
    "merged": kit.Flag.MERGED in parcel.flags,
    "x_now_mm": parcel.x_now_mm(status),
}
for name, value in {**vars(status), **vars(parcel), **told}.items():
    print(name, int(value) if isinstance(value, int) else value)
