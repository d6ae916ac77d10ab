//! How hard a world is, property by property.

use beltgauge::source::synthetic::Random;

/// How hard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Even light, free belt, single cartons.
    Easy,
    /// Large lamps, every material, light that drifts, a belt that swings a little, perhaps a fisheye.
    Industrial,
    /// One or two small lamps: hard shadows, glare.
    HardLight,
    /// Cartons 8 to 60 mm apart, also in two lanes, many of them black.
    Dense,
    /// Ribs or modules of strict pitch and little else to see; parcels on it from the first frame on.
    Periodic,
    /// 2 to 6 grey levels of noise, blur, JPEG, automatic exposure.
    Noisy,
    /// Tubes, bags, totes, stacks, envelopes, books; 20 to 800 mm long, 3 to 500 mm high; straps, wrap,
    /// labels to the edge.
    Shapes,
    /// Dirt, seams, stuck labels and shine; side drift, stops, creeping back; parcels that slide and turn.
    Worn,
    /// Hands, sleeves, cables; a patch of sun.
    Visited,
    /// Frames lost, doubled, late, out of order, squeezed by a video codec.
    Transport,
    /// Every property of another class, at random.
    Mixed,
    /// All of it.
    Extreme,
}

impl Class {
    pub const ALL: [(Self, &'static str); 12] = [
        (Self::Easy, "easy"),
        (Self::Industrial, "industrial"),
        (Self::HardLight, "hard_light"),
        (Self::Dense, "dense"),
        (Self::Periodic, "periodic"),
        (Self::Noisy, "noisy"),
        (Self::Shapes, "shapes"),
        (Self::Worn, "worn"),
        (Self::Visited, "visited"),
        (Self::Transport, "transport"),
        (Self::Mixed, "mixed"),
        (Self::Extreme, "extreme"),
    ];

    /// Whether a property of this class has what `other` is about.
    pub fn has(self, other: Self) -> bool {
        self == other || self == Self::Extreme
    }

    /// The class of one property in a world of this class.
    pub fn of_property(self, property: Property, seeds: WorldSeed) -> Self {
        if self != Self::Mixed {
            return self;
        }
        // All but mixed and extreme.
        let simple = &Self::ALL[..Self::ALL.len() - 2];
        let mut random = Random(seeds.random(property).0 ^ 0x6d69_7865_6400);
        simple[(random.unit() * simple.len() as f64) as usize].0
    }
}

/// What can be drawn on its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Property {
    Camera,
    Belt,
    Motion,
    Wear,
    Light,
    Sun,
    Noise,
    Sensor,
    Parcels,
    Start,
    Shapes,
    Dress,
    Slip,
    Visitors,
    Transport,
}

impl Property {
    pub const ALL: [Self; 15] = [
        Self::Camera,
        Self::Belt,
        Self::Motion,
        Self::Wear,
        Self::Light,
        Self::Sun,
        Self::Noise,
        Self::Sensor,
        Self::Parcels,
        Self::Start,
        Self::Shapes,
        Self::Dress,
        Self::Slip,
        Self::Visitors,
        Self::Transport,
    ];
}

/// The seed of a world: a generator for every property, so that making one easy leaves the others as
/// they are.
#[derive(Clone, Copy, Debug)]
pub struct WorldSeed(pub u64);

impl WorldSeed {
    pub fn random(self, property: Property) -> Random {
        let mut random = Random(
            self.0.wrapping_mul(0x9e37_79b9) ^ (property as u64 + 1).wrapping_mul(0x85eb_ca6b),
        );
        // Near seeds begin alike.
        random.bits();
        random
    }
}
