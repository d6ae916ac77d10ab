//! The laboratory's two techniques and Beltgauge on the same frames.
//!
//! A thesis measured boxes under one camera by two-view geometry. Both of its techniques are
//! rebuilt here from `OpenCV`'s parts, as it describes them; where it says nothing, a comment
//! says what was chosen, in its favour. This prints the sizes and errors of all three beside the
//! errors that the thesis published for boxes of the same sizes:
//!
//! `cargo test -p hil --test lab_baseline -- --nocapture`

use nalgebra::{Matrix3, Matrix3x4, SMatrix, Vector3};
use opencv::core::{self, Mat, Point, Point2d, Point2f, Size, Size2f, TermCriteria, Vector};
use opencv::{Result, calib3d, imgproc, prelude::*, video};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};

const OBJECTS: [&str; 4] = ["A", "B", "C", "D"];
/// The one of them whose size the techniques know. The thesis names none for technique 1; for
/// technique 2 its factor, 8.45, turns what it measured as A's length into A's length.
const REFERENCE: usize = 0;
/// Errors of technique 1 and 2 that the thesis reports, percent.
const PUBLISHED: [[f64; 4]; 2] = [[20.0, 13.0, 9.6, 16.0], [10.0, 16.0, 6.5, f64::NAN]];
/// Of a corner, relative to the best; the thesis found one "after several simulations".
const MIN_QUALITIES: [f64; 5] = [0.05, 0.01, 0.005, 0.002, 0.001];
/// How far an epipolar inlier may be from its line.
const EPIPOLAR_PX: f64 = 1.0;

/// Length, width and height; NaN where a technique finds nothing.
type Dimensions = [f64; 3];
const NOTHING: Dimensions = [f64::NAN; 3];
/// Places in the first view of a pair, and in the second.
type Tracks = [Vector<Point2d>; 2];

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

fn size_mm(value: &Value) -> Dimensions {
    ["length_mm", "width_mm", "height_mm"].map(|key| number(&value[key]))
}

/// What the data say of the camera, which is above the world's origin, and of the parcels.
struct Truth(Value);

impl Truth {
    fn matrix(&self, key: &str) -> Matrix3<f64> {
        Matrix3::from_fn(|i, k| number(&self.0[key][i][k]))
    }

    fn parcel(&self, id: &str) -> &Value {
        let mut parcels = self.0["parcels"].as_array().expect("a list").iter();
        parcels.find(|p| p["id"] == id).expect("a parcel of this name")
    }

    /// The centre of a parcel's top face in a frame.
    fn top_mm(&self, id: &str, frame: usize) -> Vector3<f64> {
        let at = &self.parcel(id)["centre_at_zero_displacement_mm"];
        let travel_mm = number(&self.0["belt_displacement_mm"][frame]);
        Vector3::new(number(&at[0]) + travel_mm, number(&at[1]), size_mm(self.parcel(id))[2])
    }

    /// Two frames, three apart, around the moment when a parcel is under the camera.
    fn pair(&self, id: &str) -> [usize; 2] {
        let off_mm = |f: usize| self.top_mm(id, f).x.abs();
        let frames = 0..number(&self.0["n_frames"]) as usize;
        let under = frames.min_by(|&a, &b| off_mm(a).total_cmp(&off_mm(b))).expect("frames");
        [under - 1, under + 2]
    }
}

/// A matrix for `OpenCV`.
fn mat<const R: usize, const C: usize>(m: &SMatrix<f64, R, C>) -> Result<Mat> {
    let rows: Vec<Vec<f64>> = m.row_iter().map(|r| r.iter().copied().collect()).collect();
    Mat::from_slice_2d(&rows)
}

fn square(side_px: i32) -> Result<Mat> {
    imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(side_px, side_px))
}

/// Longer side, shorter side.
fn sides(size: Size2f) -> [f64; 2] {
    [size.width.max(size.height).into(), size.width.min(size.height).into()]
}

/// A decoder that writes grey frames to its output.
fn decoder(video: &Path, how: &[&str]) -> Command {
    let mut ffmpeg = Command::new("ffmpeg");
    ffmpeg.args(["-v", "error", "-i"]).arg(video).args(["-pix_fmt", "gray"]).args(how).arg("-");
    ffmpeg.stdout(Stdio::piped());
    ffmpeg
}

/// An undistorted frame and the outlines of what moves in it.
struct View {
    image: Mat,
    blobs: Vector<Vector<Point>>,
}

impl View {
    /// The blob with the centre of the parcel's top: which object is which is told.
    fn blob_of(&self, truth: &Truth, id: &str, frame: usize) -> Option<usize> {
        let shift_mm = Vector3::from_fn(|i, _| number(&truth.0["t_world_to_camera_mm"][i]));
        let place_mm = truth.matrix("R_world_to_camera") * truth.top_mm(id, frame) + shift_mm;
        let at = truth.matrix("camera_matrix") * place_mm / place_mm.z;
        let at = Point2f::new(at.x as f32, at.y as f32);
        let side = |b: Vector<Point>| imgproc::point_polygon_test(&b, at, false);
        self.blobs.iter().position(|b| side(b).is_ok_and(|side| side > 0.0))
    }

    /// Blobs and their edges.
    fn mask(&self, blobs: &Vector<Vector<Point>>) -> Result<Mat> {
        let mut mask = Mat::zeros_size(self.image.size()?, core::CV_8U)?.to_mat()?;
        imgproc::fill_poly_def(&mut mask, blobs, 255.into())?;
        let mut grown = Mat::default();
        imgproc::dilate_def(&mask, &mut grown, &square(7)?)?;
        Ok(grown)
    }
}

/// Undistort, subtract the background (a mixture of Gaussians of the empty belt, without what
/// it calls shadow), open, close and label, in the frames that are wanted.
fn views(video: &Path, truth: &Truth, wanted: &[usize]) -> Result<BTreeMap<usize, View>> {
    let [width, height] = [0, 1].map(|i| number(&truth.0["image_size"][i]) as i32);
    let empty = number(&truth.0["n_empty_frames_at_start"]) as usize;
    let numbers: Vec<usize> = (0..empty).chain(wanted.iter().copied()).collect();
    let picks: Vec<String> = numbers.iter().map(|n| format!("eq(n,{n})")).collect();
    let pick = format!("select='{}'", picks.join("+"));
    let how = ["-vf", &pick, "-fps_mode", "passthrough", "-f", "rawvideo"];
    let decoded = decoder(video, &how).output().expect("ffmpeg is installed").stdout;
    assert_eq!(decoded.len(), numbers.len() * (width * height) as usize, "frames are missing");
    let camera = mat(&truth.matrix("camera_matrix"))?;
    let coefficient = |i: usize| number(&truth.0["dist_coeffs_k1_k2_p1_p2_k3"][i]);
    let lens: Vector<f64> = (0..5).map(coefficient).collect();
    let mut background = video::create_background_subtractor_mog2_def()?;
    let mut views = BTreeMap::new();
    for (frame, pixels) in numbers.iter().zip(decoded.chunks((width * height) as usize)) {
        let raw = Mat::new_rows_cols_with_data(height, width, pixels)?;
        let (mut image, mut a, mut b) = (Mat::default(), Mat::default(), Mat::default());
        calib3d::undistort_def(&raw, &mut image, &camera, &lens)?;
        let rate = if *frame < empty { -1.0 } else { 0.0 };
        BackgroundSubtractorMOG2Trait::apply(&mut background, &image, &mut a, rate)?;
        imgproc::threshold(&a, &mut b, 200.0, 255.0, imgproc::THRESH_BINARY)?;
        imgproc::morphology_ex_def(&b, &mut a, imgproc::MORPH_OPEN, &square(5)?)?;
        imgproc::morphology_ex_def(&a, &mut b, imgproc::MORPH_CLOSE, &square(15)?)?;
        let mut all = Vector::<Vector<Point>>::new();
        let (outer, simple) = (imgproc::RETR_EXTERNAL, imgproc::CHAIN_APPROX_SIMPLE);
        imgproc::find_contours_def(&b, &mut all, outer, simple)?;
        let noise = |b: &Vector<Point>| imgproc::contour_area_def(b).is_ok_and(|px| px < 1000.0);
        let blobs = all.iter().filter(|b| !noise(b)).collect();
        views.insert(*frame, View { image, blobs });
    }
    Ok(views)
}

/// Minimum eigenvalue corners under a mask, tracked by pyramidal Lucas-Kanade. Chosen in the
/// techniques' favour: tracks must lead back to where they began, and away from there.
fn tracks([p, q]: [&View; 2], mask: &Mat, min_quality: f64) -> Result<Tracks> {
    let (p, q, mut tracks) = (&p.image, &q.image, Tracks::default());
    let mut from = Vector::<Point2f>::new();
    imgproc::good_features_to_track(p, &mut from, 4000, min_quality, 5.0, mask, 3, false, 0.04)?;
    if from.is_empty() {
        return Ok(tracks);
    }
    let (mut to, mut back) = (Vector::<Point2f>::new(), Vector::<Point2f>::new());
    let (mut there, mut again) = (Vector::<u8>::new(), Vector::<u8>::new());
    let mut errors = Vector::<f32>::new();
    video::calc_optical_flow_pyr_lk_def(p, q, &from, &mut to, &mut there, &mut errors)?;
    video::calc_optical_flow_pyr_lk_def(q, p, &to, &mut back, &mut again, &mut errors)?;
    for (i, a) in from.iter().enumerate() {
        let (b, c) = (to.get(i)?, back.get(i)?);
        let followed = there.get(i)? != 0 && again.get(i)? != 0;
        if followed && (a - c).norm() < 0.5 && (a - b).norm() > 3.0 {
            tracks[0].push(Point2d::new(a.x.into(), a.y.into()));
            tracks[1].push(Point2d::new(b.x.into(), b.y.into()));
        }
    }
    Ok(tracks)
}

/// The second view relative to the first; the unit of length is the way between them.
struct Pose {
    fundamental: Matrix3<f64>,
    projections: [Mat; 2],
    turn_deg: f64,
}

impl Pose {
    /// Fundamental matrix, essential matrix, decomposition; `None` when they fail or when more
    /// than a tenth of the points comes to lie behind a camera.
    fn of(camera: &Matrix3<f64>, [a, b]: &Tracks) -> Result<Option<Self>> {
        let (mut inliers, ransac) = (Vector::<u8>::new(), calib3d::FM_RANSAC);
        let found = (a.len() > 7).then(|| {
            calib3d::find_fundamental_mat_mask(a, b, &mut inliers, ransac, EPIPOLAR_PX, 0.99)
        });
        let Some(found) = found.transpose()?.filter(|f| f.rows() == 3) else { return Ok(None) };
        let all = inliers.iter().filter(|&inlier| inlier != 0).count();
        let fundamental = Matrix3::from_row_slice(found.data_typed()?);
        let (e, k) = (mat(&(camera.transpose() * fundamental * camera))?, mat(camera)?);
        let (mut r, mut t) = (Mat::default(), Mat::default());
        let front = calib3d::recover_pose_estimated(&e, a, b, &k, &mut r, &mut t, &mut inliers)?;
        let (r, t) = (Matrix3::<f64>::from_row_slice(r.data_typed()?), t.data_typed::<f64>()?);
        let moved = Matrix3x4::from_fn(|i, k| if k < 3 { r[(i, k)] } else { t[i] });
        let projections = [mat(&(camera * Matrix3x4::identity()))?, mat(&(camera * moved))?];
        let turn_deg = (0.5 * (r.trace() - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
        let pose = Self { fundamental, projections, turn_deg };
        Ok((front as usize * 10 >= all * 9).then_some(pose))
    }

    /// The pose for all frames. The thesis takes one pair and tunes until the result is
    /// consistent; here all are tried and, as a belt does not turn, the smallest turn wins.
    fn of_belt(truth: &Truth, views: &BTreeMap<usize, View>) -> Result<Self> {
        let mut found = Vec::new();
        for pair in OBJECTS.map(|id| truth.pair(id).map(|f| &views[&f])) {
            for min_quality in MIN_QUALITIES {
                let tracks = tracks(pair, &pair[0].mask(&pair[0].blobs)?, min_quality)?;
                found.extend(Self::of(&truth.matrix("camera_matrix"), &tracks)?);
            }
        }
        let least = found.into_iter().min_by(|a, b| a.turn_deg.total_cmp(&b.turn_deg));
        Ok(least.expect("a pose from one of the pairs"))
    }

    fn triangulated(&self, [a, b]: &Tracks) -> Result<Vec<Vector3<f64>>> {
        let (n, [p, q], mut found) = (a.len(), &self.projections, Mat::default());
        if n > 0 {
            calib3d::triangulate_points(p, q, a, b, &mut found)?;
        }
        let all = found.data_typed::<f64>()?;
        let place = |i| Vector3::from_fn(|k, _| all[k * n + i] / all[3 * n + i]);
        Ok((0..n).map(place).collect())
    }

    /// Technique 1, unscaled: the sides of the blob's smallest rectangle, and the distance of
    /// its centre, triangulated from the rectangles of both views.
    fn rectangle(&self, a: &Vector<Point>, b: &Vector<Point>) -> Result<Dimensions> {
        let (a, b) = (imgproc::min_area_rect(a)?, imgproc::min_area_rect(b)?);
        let centre = |c: Point2f| Vector::from_iter([Point2d::new(c.x.into(), c.y.into())]);
        let [length, width] = sides(a.size);
        let places = self.triangulated(&[centre(a.center), centre(b.center)])?;
        Ok([length, width, places[0].norm()])
    }

    /// Technique 2, unscaled: the smallest cuboid, upright as the camera looks straight down,
    /// about a blob's cluster. The thesis lets k-means part the cloud into objects; in its
    /// favour clusters start as the blobs, and only points count that stay in their own.
    fn cuboid(&self, pair: [&View; 2], own: usize) -> Result<Dimensions> {
        let (mut cloud, mut labels) = (Vec::<[f32; 3]>::new(), Vec::<[i32; 1]>::new());
        let min_quality = MIN_QUALITIES[MIN_QUALITIES.len() - 1];
        for (i, blob) in pair[0].blobs.iter().enumerate() {
            let mask = pair[0].mask(&Vector::from_iter([blob]))?;
            let tracks = tracks(pair, &mask, min_quality)?;
            for (track, place) in self.triangulated(&tracks)?.iter().enumerate() {
                let [a, b] = [tracks[0].get(track)?, tracks[1].get(track)?];
                let line = self.fundamental * Vector3::new(a.x, a.y, 1.0);
                let off = line.dot(&Vector3::new(b.x, b.y, 1.0)) / line.xy().norm();
                if off.abs() < EPIPOLAR_PX {
                    cloud.push(place.cast::<f32>().into());
                    labels.push([i as i32]);
                }
            }
        }
        let (k, flags) = (pair[0].blobs.len() as i32, core::KMEANS_USE_INITIAL_LABELS);
        let kind = core::TermCriteria_COUNT + core::TermCriteria_EPS;
        let (data, mut found) = (Mat::from_slice_2d(&cloud)?, Mat::from_slice_2d(&labels)?);
        core::kmeans_def(&data, k, &mut found, TermCriteria::new(kind, 100, 1e-4)?, 1, flags)?;
        let found = found.data_typed::<i32>()?;
        let stays = |i: &usize| labels[*i][0] == own as i32 && found[*i] == own as i32;
        let mine: Vec<[f32; 3]> = (0..cloud.len()).filter(stays).map(|i| cloud[i]).collect();
        if mine.len() < 4 {
            return Ok(NOTHING);
        }
        let plan: Vector<Point2f> = mine.iter().map(|p| Point2f::new(p[0], p[1])).collect();
        let [length, width] = sides(imgproc::min_area_rect(&plan)?.size);
        let depths = || mine.iter().map(|p| f64::from(p[2]));
        let height = depths().fold(f64::MIN, f64::max) - depths().fold(f64::MAX, f64::min);
        Ok([length, width, height])
    }
}

/// Both techniques, scaled with the reference.
fn laboratory(video: &Path, truth: &Truth) -> Result<[[Dimensions; 4]; 2]> {
    let mut wanted = OBJECTS.map(|id| truth.pair(id)).concat();
    wanted.sort_unstable();
    wanted.dedup();
    let views = views(video, truth, &wanted)?;
    let pose = Pose::of_belt(truth, &views)?;
    let (mut rectangles, mut cuboids) = ([NOTHING; 4], [NOTHING; 4]);
    for (i, id) in OBJECTS.iter().enumerate() {
        let pair = truth.pair(id).map(|f| &views[&f]);
        let [a, b] = truth.pair(id).map(|f| views[&f].blob_of(truth, id, f));
        if let (Some(a), Some(b)) = (a, b) {
            rectangles[i] = pose.rectangle(&pair[0].blobs.get(a)?, &pair[1].blobs.get(b)?)?;
            cuboids[i] = pose.cuboid(pair, a)?;
        }
    }
    // Height is the belt's distance less the object's. The thesis has the former from a known
    // object, and does not say how it scales distances: here with that object's length.
    let known_mm = size_mm(truth.parcel(OBJECTS[REFERENCE]));
    let [length_px, _, distance] = rectangles[REFERENCE];
    let mm_per_px = known_mm[0] / length_px;
    let mm_per_unit = mm_per_px * truth.matrix("camera_matrix")[(0, 0)] / distance;
    let belt_mm = distance * mm_per_unit + known_mm[2];
    let scale = known_mm[0] / cuboids[REFERENCE][0];
    let scaled = |[l, w, d]: Dimensions| [l * mm_per_px, w * mm_per_px, belt_mm - d * mm_per_unit];
    Ok([rectangles.map(scaled), cuboids.map(|sides| sides.map(|side| side * scale))])
}

/// Beltgauge on the same video with the same camera and a nominal belt speed that is 2 % wrong;
/// its records are matched by place.
fn product(video: &Path, truth: &Truth) -> [Dimensions; 4] {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("lab_baseline");
    std::fs::create_dir_all(&folder).expect("writable");
    let (t, k) = (&truth.0, &truth.0["camera_matrix"]);
    let [fx, fy, cx, cy] = [&k[0][0], &k[1][1], &k[0][2], &k[1][2]];
    let [size, lens] = ["image_size", "dist_coeffs_k1_k2_p1_p2_k3"].map(|key| &t[key]);
    let [turn, shift] = ["R_world_to_camera", "t_world_to_camera_mm"].map(|key| &t[key]);
    let camera = format!(
        "image_size_px = {size}\n[lens]\nmodel = \"brown\"\nfx_px = {fx}\nfy_px = {fy}\n\
         cx_px = {cx}\ncy_px = {cy}\ndistortion = {lens}\n\
         [pose]\nrotation = {turn}\ntranslation_mm = {shift}\n"
    );
    let nominal_mm_per_s = 1.02 * number(&t["belt_speed_mm_s"]);
    let config = format!(
        "[camera]\ncalibration = \"camera.toml\"\n[zone]\nx_min_mm = -600\nx_max_mm = 600\n\
         y_min_mm = -380\ny_max_mm = 380\n[belt]\nspeed_mm_per_s = {nominal_mm_per_s}\n"
    );
    std::fs::write(folder.join("camera.toml"), camera).expect("writable");
    std::fs::write(folder.join("beltgauge.toml"), config).expect("writable");
    let mut command = Command::new(hil::beltgauge());
    command.args(["measure", "-", "--config", "beltgauge.toml", "--jsonl", "parcels.jsonl"]);
    let mut ffmpeg = decoder(video, &["-f", "yuv4mpegpipe", "-strict", "-1"]);
    let mut ffmpeg = ffmpeg.spawn().expect("ffmpeg is installed");
    let frames = ffmpeg.stdout.take().expect("piped");
    let ended = command.current_dir(&folder).stdin(frames).stdout(Stdio::null()).status();
    assert!(ended.expect("starts").success() && ffmpeg.wait().expect("ends").success());
    let text = std::fs::read_to_string(folder.join("parcels.jsonl")).expect("written");
    let parsed = text.lines().map(|line| serde_json::from_str(line).expect("JSON"));
    let records: Vec<Value> = parsed.collect();
    let off_mm = |id: &str, record: &Value| {
        let at = truth.top_mm(id, number(&record["frame"]) as usize);
        (at.x - number(&record["x_mm"])).hypot(at.y - number(&record["y_mm"]))
    };
    OBJECTS.map(|id| records.iter().find(|r| off_mm(id, r) < 80.0).map_or(NOTHING, size_mm))
}

/// Of what there is, without the NaNs.
fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn beltgauge_is_several_times_as_exact_as_the_laboratory() {
    let data = hil::project().join("../shared/data/rendered/public_a");
    if !data.exists() {
        assert!(std::env::var("CI").as_deref() != Ok("true"), "no {}", data.display());
        println!("skipped: no data ({})", data.display());
        return;
    }
    let text = std::fs::read_to_string(data.join("truth.json")).expect("readable");
    let truth = Truth(serde_json::from_str(&text).expect("JSON"));
    let video = data.join("public_a.mkv");
    let [first, second] = laboratory(&video, &truth).expect("OpenCV's functions work");
    let sizes_mm = [first, second, product(&video, &truth)];
    let truths_mm = OBJECTS.map(|id| size_mm(truth.parcel(id)));
    // Mean relative error of the three sides, percent.
    let error = |t: usize, i: usize| {
        let sides = sizes_mm[t][i].iter().zip(truths_mm[i]);
        sides.map(|(side, truth)| 100.0 * (side / truth - 1.0).abs()).sum::<f64>() / 3.0
    };
    println!("mm; mean relative error in %, [published]; * gave the scale, not in the mean");
    println!("{:19}{:37}{:37}Beltgauge", "   truth", "technique 1", "technique 2");
    for (i, id) in OBJECTS.iter().enumerate() {
        let [l, w, h] = truths_mm[i];
        print!("{id} {l:5.0}{w:5.0}{h:5.0} ");
        for (t, [l, w, h]) in sizes_mm.map(|all| all[i]).into_iter().enumerate() {
            print!("{l:7.1}{w:7.1}{h:7.1} {:5.2}", error(t, i));
            let mark = if i == REFERENCE { '*' } else { ' ' };
            if let Some(published) = PUBLISHED.get(t).map(|p| p[i]) {
                let known = published.is_finite();
                let published = if known { format!("{published:.1}") } else { "-".into() };
                print!("{mark}[{published:>4}]   ");
            }
        }
        println!();
    }
    let means = [0, 1, 2].map(|t| {
        mean((0..OBJECTS.len()).filter(|&i| t == 2 || i != REFERENCE).map(|i| error(t, i)))
    });
    let [lab_1, lab_2, ours] = means;
    let [p1, p2] = PUBLISHED.map(mean);
    println!("mean{lab_1:40.2} [{p1:4.1}]{lab_2:30.2} [{p2:4.1}]{ours:30.2}");
    for (i, sizes) in [first, second].iter().enumerate() {
        let finite = sizes.iter().filter(|s| s.iter().all(|side| side.is_finite())).count();
        assert!(finite >= 3, "technique {}: {finite} sizes", i + 1);
    }
    assert!(sizes_mm[2].iter().flatten().all(|side| side.is_finite()), "a parcel is missing");
    assert!(ours <= 0.6, "Beltgauge's mean error {ours:.2} %");
    assert!(lab_1.min(lab_2) >= 5.0 * ours, "{means:?}");
}
