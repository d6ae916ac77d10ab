//! What is on a parcel's faces: print, label, tape, straps, creases of a film.

use super::parcel::{Material, Parcel};

/// No parcel surface.
pub(super) const NOTHING: u8 = 0;
/// The top, where nothing is stuck or printed on it.
pub(super) const TOP: u8 = 1;
const LABEL: u8 = 2;
const BAR: u8 = 3;
const TAPE: u8 = 4;
/// The first of the four sides.
const SIDE: u8 = 5;
const STRAP: u8 = 10;
/// The first of the inks.
const PRINT: u8 = 16;
/// The inside of a tote: added to the surface's own number.
pub(super) const INSIDE: u8 = 32;

/// Size of a shipping label.
const LABEL_MM: [f32; 2] = [100.0, 70.0];
const STRAP_HALF_MM: f32 = 6.0;

/// A surface's identity and its grey level in full light.
#[derive(Clone, Copy)]
pub(super) struct Surface {
    pub(super) id: u8,
    pub(super) grey: f32,
}

/// What a surface lies on: whatever is stuck or printed on the top is the top.
pub(super) fn face(id: u8) -> u8 {
    match id {
        LABEL | BAR | TAPE | PRINT..INSIDE => TOP,
        other => other,
    }
}

/// Grey level of the bare surface in full light.
fn plain_grey(material: Material) -> f32 {
    match material {
        Material::Kraft => 105.0,
        Material::White | Material::Printed => 190.0,
        Material::Glossy => 150.0,
        Material::Dark => 20.0,
    }
}

/// A strap at a place along the length, on any face.
fn strap(parcel: &Parcel, half: [f32; 2], a: f32) -> Option<Surface> {
    let count = f32::from(parcel.straps);
    // Evenly along the length: the nearest one.
    let pitch = 2.0 * half[0] / count.max(1.0);
    let from_first = (a + half[0]) / pitch - 0.5;
    let off = (from_first - from_first.round()).abs() * pitch;
    let bright = plain_grey(parcel.material) > 100.0;
    let grey = if bright { 25.0 } else { 160.0 };
    (count > 0.0 && off < STRAP_HALF_MM).then_some(Surface { id: STRAP, grey })
}

/// The label: where a point is from its middle, and its half sides.
fn label(parcel: &Parcel, half: [f32; 2], [a, b]: [f32; 2]) -> ([f32; 2], [f32; 2]) {
    if let Some(edge_mm) = parcel.label_edge_mm {
        let sides = [0, 1].map(|k| (0.5 * LABEL_MM[k]).min(0.42 * half[k]));
        let middle = [0, 1].map(|k| half[k] - edge_mm as f32 - sides[k]);
        return ([a + middle[0], b - middle[1]], sides);
    }
    // In one quarter, up to 80 x 50 mm.
    (
        [a + 0.45 * half[0], b - 0.4 * half[1]],
        [(0.4 * half[0]).min(40.0), (0.4 * half[1]).min(25.0)],
    )
}

/// Top face: plain, tape along the middle, label with bars, straps.
pub(super) fn top(parcel: &Parcel, half: [f32; 2], [a, b]: [f32; 2]) -> Surface {
    if let Some(strap) = strap(parcel, half, a) {
        return strap;
    }
    let ([la, lb], sides) = label(parcel, half, [a, b]);
    if la.abs() < sides[0] && lb.abs() < sides[1] {
        let bar = lb < 0.0 && ((la + sides[0]) / 3.0) as u32 % 2 == 1;
        return if bar {
            Surface { id: BAR, grey: 40.0 }
        } else {
            Surface { id: LABEL, grey: 215.0 }
        };
    }
    let tape_half = (0.25 * half[1]).min(25.0);
    if (parcel.material == Material::Kraft || parcel.tape) && b.abs() < tape_half {
        // Brown on white, white on brown; kraft's own is of its colour.
        let bright = plain_grey(parcel.material) > 120.0;
        let grey = if !parcel.tape {
            135.0
        } else if bright {
            120.0
        } else {
            185.0
        };
        return Surface { id: TAPE, grey };
    }
    let plain = plain_grey(parcel.material);
    if parcel.material == Material::Printed {
        // Blocks of ink, in no order that repeats soon.
        let step = (4.0 * scatter((a / 17.0).floor(), (b / 11.0).floor())) as u8;
        return Surface { id: PRINT + step, grey: plain * (1.0 - 0.2 * f32::from(step)) };
    }
    Surface { id: TOP, grey: plain }
}

/// Side face, 1 to 4, in its shade: darker towards the belt. `a` is along the length, then the share of
/// the height.
pub(super) fn side(
    parcel: &Parcel,
    half: [f32; 2],
    face: usize,
    shade: f32,
    [a, z_share]: [f32; 2],
) -> Surface {
    let lower = 0.7 + 0.3 * z_share.clamp(0.0, 1.0);
    match strap(parcel, half, a) {
        Some(strap) if face > 2 => Surface { grey: strap.grey * shade * lower, ..strap },
        _ => {
            let grey = plain_grey(parcel.material) * shade * lower;
            Surface { id: SIDE + face as u8 - 1, grey }
        }
    }
}

/// How much of a lamp's image a crease of the film throws back at a point of the top: streaks.
pub(super) fn crease(seed: f32, [a, b]: [f32; 2]) -> f32 {
    let along = scatter(seed, ((a + 0.6 * b) / 9.0).floor());
    let wave = ((0.7 * a - b) * 0.11 + 6.3 * along).sin();
    (along * wave).max(0.0).powi(2)
}

/// 0 to 1, in no order.
fn scatter(i: f32, j: f32) -> f32 {
    let ink = (i * 12.9898 + j * 78.233).sin() * 43758.547;
    ink - ink.floor()
}
