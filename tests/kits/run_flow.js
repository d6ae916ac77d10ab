// Runs the function node of config/kits/node-red/flow.json (first argument) as Node-RED does, beside a Modbus client that
// answers with the registers on standard input. Prints what it makes of them.
const fs = require("fs");

const registers = fs.readFileSync(0, "utf8").trim().split(/\s+/).map(Number);
const nodes = JSON.parse(fs.readFileSync(process.argv[2], "utf8"));
const written = [];

class ModbusRTU {
    isOpen = false;
    setTimeout() {}
    async connectTCP() { this.isOpen = true; }
    async readHoldingRegisters(address, count) { return { data: registers.slice(address, address + count) }; }
    async writeRegisters(address, values) { written.push([address, values]); }
    close() { this.isOpen = false; }
}

const store = () => {
    const values = {};
    return { get: (key) => values[key], set: (key, value) => { values[key] = value; } };
};
const [context, flow, env] = [store(), store(), store()];
const AsyncFunction = (async () => {}).constructor;
const code = nodes.find((node) => node.type === "function").func;
const take = new AsyncFunction("msg", "node", "context", "flow", "env", "ModbusRTU", code);
let error = "";
const node = { status: ({ fill, text }) => { if (fill === "red") error = text; } };
const tick = () => take({}, node, context, flow, env, ModbusRTU);
const tell = (name, value) => console.log(name, Number(value));

(async () => {
    const given = await tick();
    tell("is_known", error === "");
    if (!given) return;
    const { utc, flags, not_measured, ...parcel } = given.payload;
    tell("utc", !Number.isNaN(Date.parse(utc)));
    for (const [name, value] of Object.entries(parcel)) tell(name, value);
    tell("clipped", flags.includes("clipped"));
    tell("merged", flags.includes("merged"));
    tell("not_measured", not_measured !== null);
    tell("given twice", (await tick()) !== null);
    const acknowledged = () => written.filter(([address, values]) => address === 60 && values[1] === parcel.sequence % 65536);
    tell("acknowledged before it was taken", acknowledged().length);
    flow.set("taken", parcel.sequence);
    tell("given when it was taken", (await tick()) !== null);
    tell("acknowledged when it was taken", acknowledged().length);
})();
