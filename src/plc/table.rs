//! What the tables of the interface are made of: values with their place, type, unit and meaning.
//! Wire encodings, documents and decoders all read the same rows.

use crate::config::WordOrder;

/// How a value is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// One register.
    U16,
    /// One register, two's complement.
    I16,
    /// Two registers.
    U32,
    /// Two registers, two's complement.
    I32,
}

impl Type {
    /// Registers, of two bytes each.
    pub const fn registers(self) -> u16 {
        match self {
            Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 => 2,
        }
    }

    /// Whether it is in two's complement.
    pub const fn is_signed(self) -> bool {
        matches!(self, Self::I16 | Self::I32)
    }

    /// Smallest and largest stored number.
    pub const fn range(self) -> [f64; 2] {
        match self {
            Self::U16 => [0.0, 65535.0],
            Self::I16 => [-32768.0, 32767.0],
            Self::U32 => [0.0, 4_294_967_295.0],
            Self::I32 => [-2_147_483_648.0, 2_147_483_647.0],
        }
    }
}

/// One value of a block that is filled from an `S`.
pub struct Field<S> {
    /// Offset from the block's first register.
    pub offset: u16,
    /// Version of the map that brought it, major in the high byte.
    pub since: u16,
    /// Name.
    pub name: &'static str,
    /// Storage.
    pub kind: Type,
    /// Unit of the value, after scaling.
    pub unit: &'static str,
    /// Stored number of one unit.
    pub scale: f64,
    /// Meaning.
    pub meaning: &'static str,
    /// The value, in units.
    pub value: fn(&S) -> f64,
}

impl<S> Field<S> {
    /// The stored number, as bits: 16 or 32 of them. What does not fit is the end of the range.
    pub fn bits(&self, source: &S) -> u32 {
        let value = (self.value)(source) * self.scale;
        // `as` saturates, and makes NaN 0.
        match self.kind {
            Type::U16 => u32::from(value.round() as u16),
            Type::I16 => u32::from(value.round() as i16 as u16),
            Type::U32 => value.round() as u32,
            Type::I32 => value.round() as i32 as u32,
        }
    }

    /// Whether it stays as it is stored where real numbers have 24 bits, which a belt outruns in a day.
    pub fn is_whole(&self) -> bool {
        self.kind == Type::U32 || (self.scale - 1.0).abs() < f64::EPSILON
    }

    /// Its name with its unit: some bare ones, `time`, are key words.
    pub fn name_with_unit(&self) -> String {
        let (name, unit) = (self.name, self.unit.replace('/', "_per_"));
        match unit.as_str() {
            "" | "bits" => name.to_owned(),
            "%" => format!("{name}_percent"),
            unit if name.starts_with(unit) => name.to_owned(),
            unit => format!("{name}_{unit}"),
        }
    }

    /// The same for the number as it is stored, where it [stays so](Self::is_whole).
    pub fn name_as_kept(&self) -> String {
        if self.is_whole() && self.scale > 1.0 {
            format!("{}_{}_per_{}", self.name, self.scale, self.unit.replace('/', "_per_"))
        } else {
            self.name_with_unit()
        }
    }

    /// Write it into its block of registers.
    pub fn write(&self, source: &S, order: WordOrder, block: &mut [u16]) {
        let (bits, at) = (self.bits(source), usize::from(self.offset));
        match self.kind.registers() {
            1 => block[at] = bits as u16,
            _ => block[at..at + 2].copy_from_slice(&split(bits, order)),
        }
    }
}

/// The two registers of a value.
pub fn split(bits: u32, order: WordOrder) -> [u16; 2] {
    let [high, low] = [(bits >> 16) as u16, bits as u16];
    match order {
        WordOrder::HighFirst => [high, low],
        WordOrder::LowFirst => [low, high],
    }
}

/// The value of two registers.
pub fn join([first, second]: [u16; 2], order: WordOrder) -> u32 {
    let [high, low] = match order {
        WordOrder::HighFirst => [first, second],
        WordOrder::LowFirst => [second, first],
    };
    u32::from(high) << 16 | u32::from(low)
}

/// Rows of a table: `[offset, since, name, type, unit, scale, meaning, value]`.
macro_rules! fields {
    ($([$offset:expr, $since:expr, $name:expr, $kind:ident, $unit:expr, $scale:expr, $meaning:expr, $value:expr]),* $(,)?) => {
        &[$($crate::plc::table::Field {
            offset: $offset, since: $since, name: $name, kind: $crate::plc::table::Type::$kind,
            unit: $unit, scale: $scale, meaning: $meaning, value: $value,
        }),*]
    };
}
pub(super) use fields;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_split_and_joined_in_both_orders() {
        assert_eq!(split(0x1234_5678, WordOrder::HighFirst), [0x1234, 0x5678]);
        assert_eq!(split(0x1234_5678, WordOrder::LowFirst), [0x5678, 0x1234]);
        for order in [WordOrder::HighFirst, WordOrder::LowFirst] {
            assert_eq!(join(split(0xdead_beef, order), order), 0xdead_beef);
        }
    }
}
