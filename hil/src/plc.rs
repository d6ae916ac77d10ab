//! A simulated sorter PLC: it polls at its cycle time, takes each parcel from the queue, checks
//! that it is whole and follows the one before, sorts it by size and acknowledges it. Its cable is
//! pulled and it is restarted; what it had not acknowledged it must find again.
//!
//! Its decoder reads the committed `config/registers.csv`, as an engineer's tool would.

use std::collections::HashMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// Where a value of the map is and how it is read.
#[derive(Clone, Debug)]
pub struct Register {
    /// Of its first register.
    pub address: u16,
    /// In two registers.
    pub long: bool,
    /// Two's complement.
    pub signed: bool,
    /// Stored number of one unit.
    pub scale: f64,
}

/// The map, by `block.name`.
pub type Map = HashMap<String, Register>;

/// The committed map.
///
/// # Panics
/// When it is not what it should be.
pub fn map() -> Map {
    let text = std::fs::read_to_string(crate::project().join("config/registers.csv"))
        .expect("config/registers.csv is committed");
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        let register = Register {
            address: cells[0].parse().expect("an address"),
            long: cells[3].ends_with("32"),
            signed: cells[3].starts_with('I'),
            scale: cells[6].parse().expect("a scale"),
        };
        (format!("{}.{}", cells[1], cells[2]), register)
    };
    text.lines().skip(1).map(row).collect()
}

/// A Modbus client of a few lines: requests that a real one would not send can be sent too.
pub struct Client {
    stream: TcpStream,
    transaction: u16,
}

impl Client {
    /// Connect.
    ///
    /// # Errors
    /// Those of the socket.
    pub fn connect(address: SocketAddr) -> std::io::Result<Self> {
        let stream = TcpStream::connect_timeout(&address, Duration::from_secs(2))?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(Duration::from_secs(5)))?;
        Ok(Self { stream, transaction: 0 })
    }

    /// Send a request, return the answer's PDU.
    ///
    /// # Errors
    /// Those of the socket; [`std::io::ErrorKind::InvalidData`] for an answer to something else.
    pub fn request(&mut self, pdu: &[u8]) -> std::io::Result<Vec<u8>> {
        self.transaction = self.transaction.wrapping_add(1);
        let mut frame = self.transaction.to_be_bytes().to_vec();
        frame.extend([0, 0]);
        frame.extend((pdu.len() as u16 + 1).to_be_bytes());
        frame.push(1);
        frame.extend(pdu);
        self.stream.write_all(&frame)?;
        let mut head = [0; 7];
        self.stream.read_exact(&mut head)?;
        if head[..2] != frame[..2] {
            return Err(std::io::ErrorKind::InvalidData.into());
        }
        let mut answer = vec![0; usize::from(u16::from_be_bytes([head[4], head[5]])) - 1];
        self.stream.read_exact(&mut answer)?;
        Ok(answer)
    }

    /// Read holding registers.
    ///
    /// # Errors
    /// Those of [`Client::request`]; [`std::io::ErrorKind::Other`] for an exception.
    pub fn read(&mut self, address: u16, count: u16) -> std::io::Result<Vec<u16>> {
        let [[a, b], [c, d]] = [address.to_be_bytes(), count.to_be_bytes()];
        let answer = self.request(&[3, a, b, c, d])?;
        if answer[0] != 3 {
            return Err(std::io::Error::other(format!("exception {answer:?}")));
        }
        Ok(answer[2..].chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect())
    }

    /// Write registers.
    ///
    /// # Errors
    /// As for [`Client::read`].
    pub fn write(&mut self, address: u16, values: &[u16]) -> std::io::Result<()> {
        let mut pdu = vec![16];
        pdu.extend(address.to_be_bytes());
        pdu.extend((values.len() as u16).to_be_bytes());
        pdu.push(2 * values.len() as u8);
        pdu.extend(values.iter().flat_map(|value| value.to_be_bytes()));
        let answer = self.request(&pdu)?;
        if answer[0] == 16 {
            Ok(())
        } else {
            Err(std::io::Error::other(format!("exception {answer:?}")))
        }
    }
}

/// A parcel as the PLC decodes it.
#[derive(Clone, Debug, PartialEq)]
pub struct Parcel {
    /// Sequence number, first and last.
    pub sequence: [u32; 2],
    /// Length, width and height in mm.
    pub size_mm: [f64; 3],
}

/// The stored number of a value that begins `registers`.
fn bits(register: &Register, registers: &[u16]) -> u32 {
    let first = u32::from(registers[0]);
    if register.long { first << 16 | u32::from(registers[1]) } else { first }
}

/// Where the PLC sends parcels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chute {
    /// Fits a small one.
    Small,
    /// All others.
    Large,
}

/// The PLC's program and what it remembers over its own restarts.
pub struct Plc {
    map: Map,
    client: Option<Client>,
    address: SocketAddr,
    /// Every parcel it took, in order, and where it went.
    pub taken: Vec<(Parcel, Chute)>,
    /// Errors that a PLC must never see: torn, doubled, out of order, lost.
    pub complaints: Vec<String>,
    /// The command that is under way: ticket, code, argument. Kept over restarts, as `BeltgaugeCommand`
    /// of `config/plc.st` does.
    pub under_way: Option<(u16, u16, u32)>,
    beat: u16,
}

impl Plc {
    /// Not connected.
    pub fn new(address: SocketAddr) -> Self {
        let (taken, complaints) = (Vec::new(), Vec::new());
        Self { map: map(), client: None, address, taken, complaints, under_way: None, beat: 0 }
    }

    /// Its cable is pulled, or it loses power: the connection ends without a word.
    pub fn disconnect(&mut self) {
        self.client = None;
    }

    /// The stored number of a value of the status block, by name.
    ///
    /// # Errors
    /// Those of the socket.
    pub fn status(&self, name: &str) -> std::io::Result<u32> {
        let register = &self.map[&format!("status.{name}")];
        let block = Client::connect(self.address)?.read(register.address, 2)?;
        Ok(bits(register, &block))
    }

    /// A value of a block that was read from `start` on.
    fn value(&self, name: &str, start: u16, registers: &[u16]) -> f64 {
        let register = &self.map[name];
        let bits = bits(register, &registers[usize::from(register.address - start)..]);
        let number = match (register.signed, register.long) {
            (false, _) => f64::from(bits),
            (true, true) => f64::from(bits as i32),
            (true, false) => f64::from(bits as u16 as i16),
        };
        number / register.scale
    }

    /// One cycle of `BeltgaugeCommand`: gives `command` with the next ticket, or goes on with the one that
    /// is under way. Returns the result when it is there.
    ///
    /// # Errors
    /// When the connection fails: the next cycle connects anew.
    pub fn command(&mut self, command: u16, argument: u32) -> std::io::Result<Option<u16>> {
        let mut client = match self.client.take() {
            Some(client) => client,
            None => Client::connect(self.address)?,
        };
        let [done_at, ticket_at] =
            ["status.ticket_done", "command.ticket"].map(|name| self.map[name].address);
        let done = client.read(done_at, 2)?;
        let result = match self.under_way {
            Some((ticket, ..)) if ticket == done[0] => {
                self.under_way = None;
                Some(done[1])
            }
            Some((ticket, code, argument)) => {
                let [high, low] = [(argument >> 16) as u16, argument as u16];
                client.write(ticket_at, &[ticket, code, high, low])?;
                None
            }
            None => {
                self.under_way = Some((done[0] % 65535 + 1, command, argument));
                None
            }
        };
        self.client = Some(client);
        Ok(result)
    }

    /// One cycle of the program: heartbeat, at most one parcel. Returns whether there was one.
    ///
    /// # Errors
    /// When the connection fails: the next cycle connects anew.
    pub fn cycle(&mut self) -> std::io::Result<bool> {
        let mut client = match self.client.take() {
            Some(client) => client,
            None => Client::connect(self.address)?,
        };
        let (start, command) =
            (self.map["queue.sequence"].address, self.map["command.plc_heartbeat"].address);
        self.beat = self.beat.wrapping_add(1);
        client.write(command, &[self.beat])?;
        let block = client.read(start, 32)?;
        let value = |name: &str| self.value(&format!("queue.{name}"), start, &block);
        let sequence = [value("sequence") as u32, value("sequence_end") as u32];
        if sequence[0] == 0 {
            self.client = Some(client);
            return Ok(false);
        }
        let parcel = Parcel { sequence, size_mm: ["length", "width", "height"].map(value) };
        if sequence[0] != sequence[1] {
            self.complaints.push(format!("torn: {parcel:?}"));
        }
        // Acknowledged without an answer, or not yet on the disk when the appliance was killed: not a
        // new one.
        let last = self.taken.last().map_or(0, |(last, _)| last.sequence[0]);
        match sequence[0].wrapping_sub(last) {
            0 | 0x8000_0000.. => {}
            1 => {
                let chute = if parcel.size_mm[0] <= 400.0 { Chute::Small } else { Chute::Large };
                self.taken.push((parcel, chute));
            }
            _ => self.complaints.push(format!("after {last}: {parcel:?}")),
        }
        let acknowledge = self.map["command.acknowledge"].address;
        let taken = self.taken.last().map_or(0, |(last, _)| last.sequence[0]);
        client.write(acknowledge, &[taken as u16])?;
        self.client = Some(client);
        Ok(true)
    }
}
