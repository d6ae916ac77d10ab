//! What Beltgauge does to a frame, done with `OpenCV`: the rival of the benchmarks.

use beltgauge::config::Site;
use beltgauge::kernel::scalar::flow::SIDE;
use beltgauge::units::BeltPx;
use nalgebra::Vector3;
use opencv::core::{
    CV_16SC2, CV_32F, CV_32S, Mat, MatTraitConst, Point, Point2f, Ptr, Rect, RotatedRect, Scalar,
    Size, TermCriteria, Vector,
};
use opencv::imgproc;
use opencv::prelude::*;
use opencv::video::{self, BackgroundSubtractorMOG2};

/// `OpenCV`'s unit of a minimum eigenvalue, (grey levels a px)^2: its gradients are twice the central
/// difference of values from 0 to 1.
pub const SCORE_UNIT: f32 = 255.0 * 255.0 / 4.0;

/// The chain's state.
pub struct Chain {
    height: i32,
    maps: [Mat; 2],
    /// The belt view.
    pub view: Mat,
    subtractor: Ptr<BackgroundSubtractorMOG2>,
    /// Its foreground.
    pub foreground: Mat,
    /// The foreground after opening and closing.
    pub mask: Mat,
    /// Labels, and for each its box and area.
    pub labels: Mat,
    stats: Mat,
    /// Minimum eigenvalues, in units of its own: see [`SCORE_UNIT`].
    pub scores: Mat,
    last: Mat,
    corners: Vector<Point2f>,
    close: i32,
    area_min_px: i32,
}

impl Chain {
    /// The same geometry and settings as a site's pipeline.
    ///
    /// # Panics
    /// When `OpenCV` refuses: then nothing can be compared.
    pub fn new(site: &Site) -> Self {
        let [width, height] = site.view.size_px.map(|n| n as i32);
        let mut xy = [(); 2].map(|()| {
            Mat::new_rows_cols_with_default(height, width, CV_32F, Scalar::all(-1.0))
                .expect("a map")
        });
        for v in 0..height {
            for u in 0..width {
                let at = site.view.belt_point(BeltPx { u: f64::from(u), v: f64::from(v) });
                if let Some(px) = site.camera.project(Vector3::new(at.x, at.y, 0.0)) {
                    *xy[0].at_2d_mut::<f32>(v, u).expect("inside") = px.x as f32;
                    *xy[1].at_2d_mut::<f32>(v, u).expect("inside") = px.y as f32;
                }
            }
        }
        let mut maps = [Mat::default(), Mat::default()];
        let [fixed, fraction] = &mut maps;
        imgproc::convert_maps(&xy[0], &xy[1], fixed, fraction, CV_16SC2, false).expect("maps");
        let subtractor = video::create_background_subtractor_mog2(
            site.config.background.history_frames as i32,
            site.config.background.threshold_sigma.powi(2),
            false,
        );
        Self {
            height: site.camera.image_size_px[1] as i32,
            maps,
            view: Mat::default(),
            subtractor: subtractor.expect("MOG2"),
            foreground: Mat::default(),
            mask: Mat::default(),
            labels: Mat::default(),
            stats: Mat::default(),
            scores: Mat::default(),
            last: Mat::default(),
            corners: Vector::new(),
            close: site.config.segment.close_px as i32,
            area_min_px: (site.config.segment.area_min_mm2 / site.view.mm_per_px.powi(2)) as i32,
        }
    }

    /// Raw frame to belt view.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn rectify(&mut self, frame: &[u8]) {
        let width = frame.len() as i32 / self.height;
        let raw = Mat::new_rows_cols_with_data(self.height, width, frame).expect("a frame");
        imgproc::remap(
            &raw,
            &mut self.view,
            &self.maps[0],
            &self.maps[1],
            imgproc::INTER_LINEAR,
            opencv::core::BORDER_CONSTANT,
            Scalar::default(),
        )
        .expect("remap");
    }

    /// Belt view to foreground.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn subtract(&mut self) {
        BackgroundSubtractorMOG2Trait::apply(
            &mut self.subtractor,
            &self.view,
            &mut self.foreground,
            -1.0,
        )
        .expect("MOG2");
    }

    /// Foreground to blobs.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn label(&mut self) {
        self.open_and_close();
        self.connect();
    }

    /// Morphology alone.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn open_and_close(&mut self) {
        let square = imgproc::get_structuring_element(
            imgproc::MORPH_RECT,
            Size::new(3, 3),
            Point::new(-1, -1),
        )
        .expect("a square");
        let border = imgproc::morphology_default_border_value().expect("a value");
        let filter = |from: &Mat, to: &mut Mat, operation: i32, times: i32| {
            let anchor = Point::new(-1, -1);
            let kind = opencv::core::BORDER_CONSTANT;
            imgproc::morphology_ex(from, to, operation, &square, anchor, times, kind, border)
                .expect("morphology");
        };
        let mut opened = Mat::default();
        filter(&self.foreground, &mut opened, imgproc::MORPH_OPEN, 1);
        filter(&opened, &mut self.mask, imgproc::MORPH_CLOSE, self.close);
    }

    /// Labels alone.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn connect(&mut self) {
        imgproc::connected_components_with_stats(
            &self.mask,
            &mut self.labels,
            &mut self.stats,
            &mut Mat::default(),
            8,
            CV_32S,
        )
        .expect("labels");
    }

    /// Pixels of each label.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn areas(&self) -> Vec<i32> {
        let area = |label| *self.stats.at_2d::<i32>(label, 4).expect("inside");
        (1..self.stats.rows()).map(area).collect()
    }

    /// Corners in the blobs followed from the last frame, new ones found, and each blob's smallest
    /// rectangle: what a tracker and a measurement need at least.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn measure(&mut self) {
        if !self.corners.is_empty() {
            self.follow(&self.last, &self.corners, 0.0);
        }
        self.corners = self.good_corners();
        std::hint::black_box(self.rectangles());
        std::mem::swap(&mut self.last, &mut self.view);
    }

    /// The smallest rectangle around each blob that is not too small.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn rectangles(&self) -> Vec<RotatedRect> {
        let mut rectangles = Vec::new();
        for label in 1..self.stats.rows() {
            let of = |column: i32| *self.stats.at_2d::<i32>(label, column).expect("inside");
            if of(4) < self.area_min_px {
                continue;
            }
            let area = Rect::new(of(0), of(1), of(2), of(3));
            let blob = Mat::roi(&self.mask, area).expect("inside").clone_pointee();
            let mut contours = Vector::<Vector<Point>>::new();
            imgproc::find_contours(
                &blob,
                &mut contours,
                imgproc::RETR_EXTERNAL,
                imgproc::CHAIN_APPROX_NONE,
                Point::default(),
            )
            .expect("contours");
            for contour in &contours {
                let mut rectangle = imgproc::min_area_rect(&contour).expect("a rectangle");
                rectangle.center.x += area.x as f32;
                rectangle.center.y += area.y as f32;
                rectangles.push(rectangle);
            }
        }
        rectangles
    }

    /// The best corners in the mask.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn good_corners(&self) -> Vector<Point2f> {
        let mut corners = Vector::new();
        imgproc::good_features_to_track(
            &self.view,
            &mut corners,
            100,
            0.01,
            8.0,
            &self.mask,
            3,
            false,
            0.04,
        )
        .expect("corners");
        corners
    }

    /// Where corners of an earlier view are now, expected `step_px` further along the belt: with the
    /// window of ours, over a pyramid of three.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn follow(
        &self,
        before: &Mat,
        corners: &Vector<Point2f>,
        step_px: f32,
    ) -> Vec<Option<Point2f>> {
        let mut next: Vector<Point2f> =
            corners.iter().map(|at| Point2f::new(at.x + step_px, at.y)).collect();
        let (mut status, mut error) = (Vector::<u8>::new(), Vector::<f32>::new());
        video::calc_optical_flow_pyr_lk(
            before,
            &self.view,
            corners,
            &mut next,
            &mut status,
            &mut error,
            Size::new(SIDE as i32, SIDE as i32),
            2,
            TermCriteria::new(3, 10, 0.01).expect("criteria"),
            video::OPTFLOW_USE_INITIAL_FLOW,
            1e-4,
        )
        .expect("flow");
        next.iter().zip(&status).map(|(at, found)| (found == 1).then_some(at)).collect()
    }

    /// How good a corner each pixel of the view is, over the same patch and by the same gradient
    /// as ours: 13 pixels wide, central differences.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn score_corners(&mut self) {
        let border = opencv::core::BORDER_DEFAULT;
        imgproc::corner_min_eigen_val(&self.view, &mut self.scores, SIDE as i32, 1, border)
            .expect("scores");
    }

    /// One frame.
    ///
    /// # Panics
    /// When `OpenCV` refuses.
    pub fn step(&mut self, frame: &[u8]) {
        self.rectify(frame);
        self.subtract();
        self.label();
        self.measure();
    }
}
