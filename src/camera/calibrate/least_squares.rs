//! Levenberg-Marquardt on the normal equations, and its covariance.
//!
//! Source: Marquardt 1963: the diagonal is scaled, the damping follows success and failure.

use nalgebra::{DMatrix, DVector};

/// A smaller relative gain ends the iteration.
const CONVERGED: f64 = 1e-10;
const DAMPING_START: f64 = 1e-3;
const DAMPING_MAX: f64 = 1e12;

/// Cost, and its second and first derivatives in Gauss-Newton's approximation.
pub(super) struct Normal {
    pub(super) cost: f64,
    pub(super) matrix: DMatrix<f64>,
    pub(super) gradient: DVector<f64>,
}

impl Normal {
    pub(super) fn zeros(parameters: usize) -> Self {
        Self {
            cost: 0.0,
            matrix: DMatrix::zeros(parameters, parameters),
            gradient: DVector::zeros(parameters),
        }
    }

    /// Add one weighted error: the columns it depends on, and its derivatives by them.
    pub(super) fn add(&mut self, weight: f64, error: f64, columns: &[usize], slopes: &[f64]) {
        for (&i, &a) in columns.iter().zip(slopes) {
            self.gradient[i] += weight * a * error;
            for (&j, &b) in columns.iter().zip(slopes) {
                self.matrix[(i, j)] += weight * a * b;
            }
        }
    }

    /// Inverse of the matrix: the covariance for errors of variance 1. `None` when the errors
    /// do not determine the parameters. Parameters that no error depends on get 0.
    pub(super) fn covariance(&self) -> Option<DMatrix<f64>> {
        let mut matrix = self.matrix.clone();
        let unused: Vec<usize> = (0..matrix.nrows()).filter(|&k| matrix[(k, k)] == 0.0).collect();
        for &k in &unused {
            matrix[(k, k)] = 1.0;
        }
        let mut covariance = matrix.cholesky()?.inverse();
        for &k in &unused {
            covariance[(k, k)] = 0.0;
        }
        Some(covariance)
    }

    fn step(&self, damping: f64) -> Option<DVector<f64>> {
        let mut damped = self.matrix.clone();
        for k in 0..damped.nrows() {
            let diagonal = damped[(k, k)];
            damped[(k, k)] = if diagonal > 0.0 { diagonal * (1.0 + damping) } else { 1.0 };
        }
        Some(damped.cholesky()?.solve(&-&self.gradient))
    }
}

/// What is minimised: a state that knows its cost and can move.
pub(super) trait Problem: Sized {
    /// `None` where the state makes no sense, as a point behind the camera.
    fn normal(&self) -> Option<Normal>;
    /// The state after a step.
    fn moved(&self, step: &DVector<f64>) -> Self;
}

/// Go down until it converges or `steps_max` is reached. `None` when the start makes no sense.
pub(super) fn minimise<P: Problem>(start: P, steps_max: usize) -> Option<(P, Normal)> {
    let mut state = start;
    let mut normal = state.normal()?;
    let mut damping = DAMPING_START;
    for _ in 0..steps_max {
        let better = normal.step(damping).and_then(|step| {
            let next = state.moved(&step);
            let next_normal = next.normal()?;
            (next_normal.cost < normal.cost).then_some((next, next_normal))
        });
        if let Some((next, next_normal)) = better {
            let gain = (normal.cost - next_normal.cost) / normal.cost.max(f64::MIN_POSITIVE);
            (state, normal) = (next, next_normal);
            damping *= 0.2;
            if gain < CONVERGED {
                break;
            }
        } else {
            damping *= 10.0;
            if damping > DAMPING_MAX {
                break;
            }
        }
    }
    Some((state, normal))
}

/// A small problem given by its errors alone; derivatives by central differences.
pub(super) struct Numeric<F> {
    pub(super) parameters: DVector<f64>,
    /// Errors for parameters; `None` where they make no sense.
    pub(super) errors: F,
}

/// Of parameters in rad or mm: far above rounding, far below curvature.
pub(super) const DIFFERENCE: f64 = 1e-5;

impl<F: Fn(&DVector<f64>) -> Option<Vec<f64>> + Clone> Problem for Numeric<F> {
    fn normal(&self) -> Option<Normal> {
        let errors = (self.errors)(&self.parameters)?;
        let count = self.parameters.len();
        let mut slopes = vec![vec![0.0; count]; errors.len()];
        for k in 0..count {
            let moved = |sign: f64| {
                let mut parameters = self.parameters.clone();
                parameters[k] += sign * DIFFERENCE;
                (self.errors)(&parameters)
            };
            let (ahead, behind) = (moved(1.0)?, moved(-1.0)?);
            for (slopes, (a, b)) in slopes.iter_mut().zip(ahead.iter().zip(&behind)) {
                slopes[k] = (a - b) / (2.0 * DIFFERENCE);
            }
        }
        let columns: Vec<usize> = (0..count).collect();
        let mut normal = Normal::zeros(count);
        for (&error, slopes) in errors.iter().zip(&slopes) {
            normal.cost += error * error;
            normal.add(1.0, error, &columns, slopes);
        }
        Some(normal)
    }

    fn moved(&self, step: &DVector<f64>) -> Self {
        Self { parameters: &self.parameters + step, errors: self.errors.clone() }
    }
}
