//! Closed forms: homography, Zhang's intrinsics, pose of a plane, pose from space points.

use super::Pose;
use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

/// Homography from plane points to the rays (any length) on which they are seen, scaled so
/// that it maps to the rays' own side. `None` for fewer than 4 points or points on one line.
///
/// Source: Hartley and Zisserman, algorithm 4.2 (normalised direct linear transform).
pub(super) fn homography(plane: &[Vector2<f64>], rays: &[Vector3<f64>]) -> Option<Matrix3<f64>> {
    if plane.len() < 4 || plane.len() != rays.len() {
        return None;
    }
    let (centre, scale) = spread(plane)?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (p, ray) in plane.iter().zip(rays) {
        let p = ((p - centre) / scale).push(1.0);
        // ray x (H p) = 0, a row of H at a time
        let cross = ray.normalize().cross_matrix();
        let rows = SMatrix::<f64, 3, 9>::from_fn(|i, j| cross[(i, j / 3)] * p[j % 3]);
        normal += rows.transpose() * rows;
    }
    let h = smallest_eigenvector(&normal, 1e-13)?;
    let normalised = Matrix3::from_row_slice(h.as_slice());
    let shift = Matrix3::new(
        1.0 / scale,
        0.0,
        -centre.x / scale, //
        0.0,
        1.0 / scale,
        -centre.y / scale, //
        0.0,
        0.0,
        1.0,
    );
    let h = normalised * shift;
    let side: f64 = plane.iter().zip(rays).map(|(p, ray)| (h * p.push(1.0)).dot(ray)).sum();
    Some(h * side.signum())
}

/// Mean and root mean square distance from it; `None` when there is none or on one line.
fn spread(points: &[Vector2<f64>]) -> Option<(Vector2<f64>, f64)> {
    let count = points.len() as f64;
    let centre = points.iter().sum::<Vector2<f64>>() / count;
    let moments = points
        .iter()
        .map(|p| (p - centre) * (p - centre).transpose())
        .sum::<nalgebra::Matrix2<f64>>()
        / count;
    let eigen = moments.symmetric_eigenvalues();
    let (small, large) = (eigen.min(), eigen.max());
    (small > 1e-6 * large).then(|| (centre, (small + large).sqrt()))
}

/// Of a symmetric matrix; `None` when the second smallest eigenvalue is (relatively) zero too.
fn smallest_eigenvector<const N: usize>(
    matrix: &SMatrix<f64, N, N>,
    zero: f64,
) -> Option<SVector<f64, N>> {
    let dynamic = nalgebra::DMatrix::from_column_slice(N, N, matrix.as_slice());
    let eigen = dynamic.symmetric_eigen();
    let mut order: Vec<usize> = (0..N).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    (eigen.eigenvalues[order[1]] > zero * eigen.eigenvalues[order[N - 1]])
        .then(|| SVector::from_fn(|i, _| eigen.eigenvectors[(i, order[0])]))
}

/// Pose of a plane (its z axis is the third of the frame) from its homography to rays.
pub(super) fn pose_of_plane(h: &Matrix3<f64>) -> Option<Pose> {
    let (a, b, t) = (h.column(0), h.column(1), h.column(2));
    let scale = 2.0 / (a.norm() + b.norm());
    if !scale.is_finite() {
        return None;
    }
    let (a, b) = (a * scale, b * scale);
    let rotation = nearest_rotation(&Matrix3::from_columns(&[a, b, a.cross(&b)]))?;
    Some(Pose { rotation, translation_mm: t * scale })
}

/// The rotation nearest in the Frobenius norm.
pub(in crate::camera) fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = matrix.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t)
}

/// Focal lengths and principal point (fx, fy, cx, cy) from homographies of at least two planes
/// to an image without skew; `None` when the planes do not determine them. Image coordinates
/// near 1 keep it well conditioned.
///
/// Source: Zhang 2000, "A flexible new technique for camera calibration", section 3.1.
pub(super) fn zhang(homographies: &[Matrix3<f64>]) -> Option<[f64; 4]> {
    let mut normal = SMatrix::<f64, 5, 5>::zeros();
    for h in homographies {
        let h = h / h.norm();
        // b = B11, B22, B13, B23, B33 of the image of the absolute conic
        let v = |i: usize, j: usize| {
            let (a, b) = (h.column(i), h.column(j));
            SVector::<f64, 5>::from([
                a[0] * b[0],
                a[1] * b[1],
                a[2] * b[0] + a[0] * b[2],
                a[2] * b[1] + a[1] * b[2],
                a[2] * b[2],
            ])
        };
        for row in [v(0, 1), v(0, 0) - v(1, 1)] {
            normal += row * row.transpose();
        }
    }
    let b = smallest_eigenvector(&normal, 1e-12)?;
    let b = b * b[0].signum();
    let (cx, cy) = (-b[2] / b[0], -b[3] / b[1]);
    let lambda = b[4] - b[2] * b[2] / b[0] - b[3] * b[3] / b[1];
    let [fx2, fy2] = [lambda / b[0], lambda / b[1]];
    (fx2 > 0.0 && fy2 > 0.0).then(|| [fx2.sqrt(), fy2.sqrt(), cx, cy])
}

/// Pose from at least 6 points in space, not on one plane, and the rays on which they are seen.
///
/// Source: Faugeras and Toscani 1986: the direct linear transform under |third row of the
/// rotation| = 1; here for rays, whose intrinsics are the identity.
pub(super) fn pose_of_points(points: &[Vector3<f64>], rays: &[Vector3<f64>]) -> Option<Pose> {
    let centre = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let scale = points.iter().map(|p| (p - centre).norm()).sum::<f64>() / points.len() as f64;
    let mut normal = SMatrix::<f64, 12, 12>::zeros();
    for (point, ray) in points.iter().zip(rays) {
        let p = ((point - centre) / scale).push(1.0);
        let cross = ray.normalize().cross_matrix();
        let rows = SMatrix::<f64, 3, 12>::from_fn(|i, j| cross[(i, j / 4)] * p[j % 4]);
        normal += rows.transpose() * rows;
    }
    let h = smallest_eigenvector(&normal, 1e-13)?;
    let matrix = SMatrix::<f64, 3, 4>::from_row_slice(h.as_slice());
    let left = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    // The constraint fixes the scale; a rotation, not a mirror, its sign.
    let size = left.row(2).norm() * left.determinant().signum();
    let rotation = nearest_rotation(&(left / size))?;
    let translation_mm = matrix.column(3) / size * scale - rotation * centre;
    Some(Pose { rotation, translation_mm })
}
