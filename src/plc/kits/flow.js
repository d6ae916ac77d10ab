// Beltgauge, register map @version@: printed from the tables in src/plc.
// Takes every parcel from the queue, once and in order. It needs `queue = true` under [plc], this computer's address in
// modbus.write_allow, and plc.state_file, which an installed appliance has: numbers go on after a restart.
// A parcel is acknowledged when flow.taken has its number: the flow sets it when the parcel is in the file.
// After a restart of Node-RED the last parcel may come once more, with the same number.
const u32 = (block, at) => block[at] * 65536 + block[at + 1];
const i16 = (stored) => (stored << 16) >> 16;
const i32 = (stored) => stored | 0;
const FLAGS = @flags@;
const NOT_MEASURED = @not_measured@;

function decode(block) {
    return {
@parcel@
        may_be_used: (block[@valid@] & @may_be_used@) !== 0,
        is_box: (block[@valid@] & @is_box@) !== 0,
        flags: FLAGS.filter((_, bit) => (block[@flags_at@] >> bit) & 1),
        not_measured: NOT_MEASURED[block[@not_measured_at@]] || null,
    };
}

async function connected() {
    let client = context.get("client");
    if (client && client.isOpen) return client;
    client = new ModbusRTU();
    client.setTimeout(2000);
    await client.connectTCP(env.get("HOST"), { port: Number(env.get("PORT")) });
    context.set("client", client);
    const start = (await client.readHoldingRegisters(0, @identity_registers@)).data;
    if (start[@identity_at@] !== @identity@) throw new Error("this is no Beltgauge");
    if (start[@map_version_at@] >> 8 !== @map_major@) throw new Error("another register map: take its own flow");
    if (u32(start, @test_u32_at@) !== @test_u32@) throw new Error('set modbus.word_order = "high_first"');
    return client;
}

const readParcel = async (client) => decode((await client.readHoldingRegisters(@queue@, @parcel_registers@)).data);

// A heartbeat, and with it the number: one from before a restart is then left out, not refused.
async function write(client, numbers) {
    const beat = ((context.get("beat") || 0) + 1) % 65536;
    context.set("beat", beat);
    await client.writeRegisters(@plc_heartbeat@, [beat, ...numbers]);
}

// The next tick comes while this one waits for an answer.
if (context.get("busy")) return null;
context.set("busy", true);
try {
    const client = await connected();
    await write(client, []);
    let parcel = await readParcel(client);
    const known = context.get("known") || [];
    const taken = flow.get("taken");
    if (taken && !known.includes(taken)) {
        known.push(taken);
        context.set("known", known.slice(-@ring_parcels@));
    }
    if (known.includes(parcel.sequence)) {
        await write(client, [parcel.sequence % 65536]);
        parcel = await readParcel(client);
    }
    node.status({ fill: "green", shape: "dot", text: "connected" });
    if (parcel.sequence === 0 || parcel.sequence !== parcel.sequence_end || known.includes(parcel.sequence)) return null;
    // Given once; again after 10 s, if nobody took it.
    const given = context.get("given") || {};
    if (given.sequence === parcel.sequence && Date.now() - given.at_ms < 10000) return null;
    context.set("given", { sequence: parcel.sequence, at_ms: Date.now() });
    return { topic: "parcel", payload: { utc: new Date().toISOString(), ...parcel } };
} catch (error) {
    node.status({ fill: "red", shape: "ring", text: error.message });
    const client = context.get("client");
    if (client) client.close(() => {});
    context.set("client", undefined);
    return null;
} finally {
    context.set("busy", false);
}
