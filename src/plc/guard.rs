//! Stands between a client's socket and the Modbus library.
//!
//! Only requests that the server supports, whole and of the right length, get through; all
//! others get the exception that the protocol names, here. A client that is silent, slow or
//! not speaking Modbus is disconnected. The library then never sees malformed input.
//! Source: MODBUS Application Protocol V1.1b3 and Messaging on TCP/IP V1.0b.

use std::time::Duration;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::time::timeout;

/// MBAP header with unit identifier.
const HEADER_BYTES: usize = 7;
/// Largest PDU of the protocol.
const PDU_BYTES_MAX: usize = 253;
/// A request, once begun, must be complete, and an answer taken, within this time.
const EXCHANGE_TIMEOUT: Duration = Duration::from_secs(5);

const READ_COILS: u8 = 1;
const READ_DISCRETE: u8 = 2;
const READ_HOLDING: u8 = 3;
const READ_INPUT: u8 = 4;
const WRITE_ONE: u8 = 6;
const WRITE_MANY: u8 = 16;
const READ_AND_WRITE: u8 = 23;
/// Encapsulated interface, with its type "read device identification".
const IDENTIFY: [u8; 2] = [43, 14];
/// Registers, bits and written registers in one request, by the protocol.
const READ_COUNT_MAX: u16 = 125;
const BIT_COUNT_MAX: u16 = 2000;
const WRITE_COUNT_MAX: u16 = 123;
/// Written registers of a request that also reads.
const WRITE_BESIDE_READ_MAX: u16 = 121;

const ILLEGAL_FUNCTION: u8 = 1;
const ILLEGAL_DATA_ADDRESS: u8 = 2;
const ILLEGAL_DATA_VALUE: u8 = 3;

/// What to do with a request PDU.
#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    Forward,
    Refuse(u8),
    /// Tell the device's identification: read code, first object.
    Identify(u8, u8),
}

fn judge(pdu: &[u8]) -> Verdict {
    let within = |high: u8, low: u8, most: u16| {
        let count = u16::from_be_bytes([high, low]);
        if (1..=most).contains(&count) {
            Verdict::Forward
        } else {
            Verdict::Refuse(ILLEGAL_DATA_VALUE)
        }
    };
    match *pdu {
        [READ_HOLDING | READ_INPUT, _, _, high, low] => within(high, low, READ_COUNT_MAX),
        [READ_COILS | READ_DISCRETE, _, _, high, low] => within(high, low, BIT_COUNT_MAX),
        [WRITE_ONE, _, _, _, _] => Verdict::Forward,
        [WRITE_MANY, _, _, high, low, bytes, ref values @ ..]
            if values.len() == usize::from(bytes)
                && u16::from(bytes) == 2 * u16::from_be_bytes([0, low]) =>
        {
            within(high, low, WRITE_COUNT_MAX)
        }
        [READ_AND_WRITE, _, _, read_high, read_low, _, _, high, low, bytes, ref values @ ..]
            if values.len() == usize::from(bytes)
                && u16::from(bytes) == 2 * u16::from_be_bytes([0, low]) =>
        {
            match within(high, low, WRITE_BESIDE_READ_MAX) {
                Verdict::Forward => within(read_high, read_low, READ_COUNT_MAX),
                refused => refused,
            }
        }
        [function, kind, code @ 1..=4, object] if [function, kind] == IDENTIFY => {
            Verdict::Identify(code, object)
        }
        [
            READ_COILS | READ_DISCRETE | READ_HOLDING | READ_INPUT | WRITE_ONE | WRITE_MANY
            | READ_AND_WRITE,
            ..,
        ] => Verdict::Refuse(ILLEGAL_DATA_VALUE),
        [function, kind, ..] if [function, kind] == IDENTIFY => Verdict::Refuse(ILLEGAL_DATA_VALUE),
        _ => Verdict::Refuse(ILLEGAL_FUNCTION),
    }
}

/// Serve one client until it leaves, is silent for `idle`, or breaks the protocol.
/// `library` is the other end of what the Modbus library reads and writes; `note_request` is
/// told of every whole request.
pub async fn serve<C, L>(
    mut client: C,
    mut library: L,
    idle: Duration,
    note_request: impl Fn(),
) -> std::io::Result<()>
where
    C: AsyncRead + AsyncWrite + Unpin,
    L: AsyncRead + AsyncWrite + Unpin,
{
    let mut frame = [0; HEADER_BYTES + PDU_BYTES_MAX];
    loop {
        if timeout(idle, client.read_exact(&mut frame[..1])).await?.is_err() {
            return Ok(()); // the client has left
        }
        let length = timeout(EXCHANGE_TIMEOUT, read_rest(&mut client, &mut frame, 1)).await??;
        note_request();
        let answer = match judge(&frame[HEADER_BYTES..length]) {
            Verdict::Forward => {
                library.write_all(&frame[..length]).await?;
                timeout(EXCHANGE_TIMEOUT, read_rest(&mut library, &mut frame, 0)).await??
            }
            Verdict::Refuse(code) => refuse(&mut frame, code),
            Verdict::Identify(code, object) => identify(&mut frame, code, object),
        };
        timeout(EXCHANGE_TIMEOUT, client.write_all(&frame[..answer])).await??;
    }
}

/// Complete a frame of which `have` bytes are there; returns its length.
async fn read_rest<R: AsyncRead + Unpin>(
    reader: &mut R,
    frame: &mut [u8],
    have: usize,
) -> std::io::Result<usize> {
    reader.read_exact(&mut frame[have..HEADER_BYTES]).await?;
    let protocol = u16::from_be_bytes([frame[2], frame[3]]);
    // The length counts the unit identifier, the header's last byte.
    let pdu_bytes = usize::from(u16::from_be_bytes([frame[4], frame[5]])).saturating_sub(1);
    if protocol != 0 || !(1..=PDU_BYTES_MAX).contains(&pdu_bytes) {
        // Where the next frame begins cannot be known: only a new connection helps.
        return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, "not Modbus TCP"));
    }
    let length = HEADER_BYTES + pdu_bytes;
    reader.read_exact(&mut frame[HEADER_BYTES..length]).await?;
    Ok(length)
}

/// Turn the request into its exception response; returns its length.
fn refuse(frame: &mut [u8], code: u8) -> usize {
    frame[4..6].copy_from_slice(&3u16.to_be_bytes());
    frame[HEADER_BYTES] |= 0x80;
    frame[HEADER_BYTES + 1] = code;
    HEADER_BYTES + 2
}

/// Turn the request into the device's identification; returns its length. Read codes 1 to 3 ask for
/// all objects from one on, 4 for that one alone.
fn identify(frame: &mut [u8], code: u8, first: u8) -> usize {
    const BASIC: u8 = 1;
    const ONE: u8 = 4;
    let objects = super::modbus::identification();
    let known = objects.iter().any(|(id, _)| *id == first);
    if code == ONE && !known {
        return refuse(frame, ILLEGAL_DATA_ADDRESS);
    }
    // An object that is not there restarts at the first, as the protocol says.
    let from = if known { first } else { 0 };
    let wanted = objects.iter().filter(|(id, _)| match code {
        ONE => *id == first,
        BASIC => *id >= from && *id <= 2,
        _ => *id >= from,
    });
    let mut at = HEADER_BYTES + 7;
    let mut count = 0;
    for (id, text) in wanted {
        frame[at..at + 2].copy_from_slice(&[*id, text.len() as u8]);
        frame[at + 2..at + 2 + text.len()].copy_from_slice(text.as_bytes());
        at += 2 + text.len();
        count += 1;
    }
    // Conformity: regular identification, one object or a stream. Nothing follows.
    let head = [IDENTIFY[0], IDENTIFY[1], code, 0x82, 0, 0, count];
    frame[HEADER_BYTES..HEADER_BYTES + 7].copy_from_slice(&head);
    let length = (at - HEADER_BYTES + 1) as u16;
    frame[4..6].copy_from_slice(&length.to_be_bytes());
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_whole_requests_of_counts_that_the_protocol_knows_pass() {
        for pdu in [
            &[3, 0, 0, 0, 1][..],
            &[4, 255, 255, 0, 125],
            &[1, 0, 0, 0x07, 0xd0],
            &[2, 0, 0, 0, 32],
            &[6, 0, 60, 0, 1],
            &[16, 0, 60, 0, 2, 4, 0, 1, 0, 2],
            &[23, 0, 140, 0, 32, 0, 60, 0, 1, 2, 0, 7],
        ] {
            assert_eq!(judge(pdu), Verdict::Forward, "{pdu:?}");
        }
        for pdu in [
            &[3, 0, 0, 0, 0][..],
            &[3, 0, 0, 0, 126],
            &[3, 0, 0, 255, 255],
            &[3],
            &[4, 0, 0, 0, 1, 9],
            &[1, 0, 0, 0x07, 0xd1],
            &[6, 0, 60, 0],
            &[16, 0, 60, 0, 2, 4, 0, 1, 0],
            &[16, 0, 60, 0, 1, 4, 0, 1, 0, 2],
            &[16, 0, 60, 1, 2, 4, 0, 1, 0, 2],
            &[16, 0, 60, 0, 0, 0],
            &[16],
            &[23, 0, 140, 0, 0, 0, 60, 0, 1, 2, 0, 7],
            &[23, 0, 140, 0, 126, 0, 60, 0, 1, 2, 0, 7],
            &[23, 0, 140, 0, 32, 0, 60, 0, 0, 0],
            &[23, 0, 140, 0, 32, 0, 60, 0, 2, 2, 0, 7],
            &[23, 0, 140, 0, 32, 0, 60],
            &[43, 14, 0, 0],
            &[43, 14, 1],
        ] {
            assert_eq!(judge(pdu), Verdict::Refuse(ILLEGAL_DATA_VALUE), "{pdu:?}");
        }
        for function in (0..=255).filter(|f| ![1, 2, 3, 4, 6, 16, 23].contains(f)) {
            assert_eq!(judge(&[function, 0, 0, 0, 1]), Verdict::Refuse(ILLEGAL_FUNCTION));
        }
    }

    #[test]
    fn the_device_says_what_it_is() {
        let all = answer(&[0, 1, 0, 0, 0, 5, 1, 43, 14, 2, 0]);
        assert_eq!(all[..15], [0, 1, 0, 0, 0, all.len() as u8 - 6, 1, 43, 14, 2, 0x82, 0, 0, 4, 0]);
        assert!(all.windows(9).any(|text| text == b"Beltgauge"));
        assert_eq!(answer(&[0, 1, 0, 0, 0, 5, 1, 43, 14, 4, 3]), [0, 1, 0, 0, 0, 3, 1, 0xab, 2]);
    }

    /// Send bytes to a guard with no library behind it; returns what it answers.
    fn answer(bytes: &[u8]) -> Vec<u8> {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().build().expect("runtime");
        runtime.block_on(async {
            let (mut client, guarded) = tokio::io::duplex(1024);
            let (library, _other) = tokio::io::duplex(1024);
            let guard = tokio::spawn(serve(guarded, library, Duration::from_secs(1), || {}));
            client.write_all(bytes).await.expect("written");
            client.shutdown().await.expect("shut");
            let mut answer = Vec::new();
            client.read_to_end(&mut answer).await.expect("read");
            drop(guard);
            answer
        })
    }

    #[test]
    fn a_coil_write_is_answered_with_illegal_function_and_its_transaction() {
        let request = [0x12, 0x34, 0, 0, 0, 6, 9, 5, 0, 0, 0, 1];
        assert_eq!(answer(&request), [0x12, 0x34, 0, 0, 0, 3, 9, 0x85, 1]);
    }

    #[test]
    fn what_is_not_modbus_is_disconnected_without_an_answer() {
        assert!(answer(b"GET / HTTP/1.1\r\n\r\n").is_empty());
        assert!(answer(&[0, 1, 0, 0, 0, 0, 1]).is_empty(), "length 0");
        assert!(answer(&[0, 1, 0, 0, 0, 1, 1]).is_empty(), "no function code");
        assert!(answer(&[0, 1, 0, 0, 0xff, 0xff, 1]).is_empty(), "longer than any PDU");
        assert!(answer(&[0, 1, 0, 0, 0, 6, 1, 3]).is_empty(), "cut off");
    }
}
