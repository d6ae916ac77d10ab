"""Reads Beltgauge's registers with pymodbus and prints them as JSON.

usage: read_map.py HOST PORT
"""
import json
import sys

from pymodbus.client import ModbusTcpClient

client = ModbusTcpClient(sys.argv[1], port=int(sys.argv[2]), timeout=5)
assert client.connect(), "no connection"


def both(address, count):
    """Holding and input registers are the same image."""
    for unit in (1, 17, 255):
        holding = client.read_holding_registers(address, count=count, device_id=unit)
        assert not holding.isError(), holding
    inputs = client.read_input_registers(address, count=count)
    assert not inputs.isError(), inputs
    return holding.registers, inputs.registers


def u32(registers, at):
    kind = client.DATATYPE.UINT32
    return client.convert_from_registers(registers[at : at + 2], kind, word_order="big")


def i32(registers, at):
    kind = client.DATATYPE.INT32
    return client.convert_from_registers(registers[at : at + 2], kind, word_order="big")


def parcel(registers):
    return {
        "seq": u32(registers, 0),
        "valid": registers[2],
        "length": registers[4],
        "width": registers[5],
        "height": registers[6],
        "x": i32(registers, 8),
        "y": i32(registers, 10),
        "seq_end": u32(registers, 30),
    }


identity, same = both(0, 5)
assert identity == same, (identity, same)
latest = client.read_holding_registers(100, count=32).registers
ring = [client.read_holding_registers(200 + 32 * k, count=32).registers for k in range(32)]
assert not client.write_registers(60, [7]).isError()
echo = client.read_holding_registers(60, count=1).registers[0]
json.dump(
    {
        "identity": identity[0],
        "test_u32": u32(identity, 2),
        "heartbeat": client.read_holding_registers(10, count=1).registers[0],
        "latest": parcel(latest),
        "ring": [parcel(block) for block in ring if u32(block, 0)],
        "bits": client.read_discrete_inputs(0, count=32).bits[:2],
        "status": client.read_holding_registers(11, count=1).registers[0],
        "identification": client.read_device_information(read_code=2).information[0].decode(),
        "heartbeat of the PLC": echo,
        "exceptions": {
            "beyond the map": client.read_holding_registers(1224, count=1).exception_code,
            "across its end": client.read_holding_registers(1200, count=125).exception_code,
            "write one": client.write_register(100, 1).exception_code,
            "write many": client.write_registers(100, [1, 2]).exception_code,
            "write across the command block's end": client.write_registers(69, [1, 2]).exception_code,
            "acknowledge what never was": client.write_register(61, 999).exception_code,
            "bits beyond the words": client.read_coils(32, count=1).exception_code,
            "write a coil": client.write_coil(0, True).exception_code,
        },
    },
    sys.stdout,
)
client.close()
