use std::f64::consts::TAU;

use barchan_geometry::Se3;
use barchan_geometry::nalgebra::{Matrix3, Rotation3, Translation3};
use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::options::{Options, RouteKind};
use super::surface::Surface;

/// Seconds that a stop lasts; with a full turn of the mast, as Hong et al. (2021) survey.
const STOP: f64 = 6.0;
const STOP_WITH_TURN: f64 = 24.0;
/// Seconds from standing to full speed.
const RAMP: f64 = 1.5;
/// Wheels: ahead of or behind the middle, and to the left and right of it, metres.
const WHEELS: ([f64; 3], f64) = ([-0.45, 0.0, 0.45], 0.35);
/// Corner radius of the survey's lanes, metres.
const CORNER: f64 = 0.9;

/// Where the rover drives, how fast, and where its mast looks: all known before the ground is.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    kind: RouteKind,
    /// Middle of the site.
    pub centre: Vector2<f64>,
    /// Size of the route, times the usual.
    pub scale: f64,
    /// Metres that each round of the circle lies outside of the one before.
    beside: f64,
    /// Where on the circle it starts, or where the straight line leads, radians.
    start: f64,
    speed: f64,
    /// Metres between stops; zero for none.
    between_stops: f64,
    /// Whether the mast turns at stops.
    turns: bool,
    pan: f64,
    tilt: f64,
    mast: f64,
    baseline: f64,
}

impl Plan {
    /// The radius of the circle, metres, for a scale of 1.
    pub const RADIUS: f64 = 9.0;
    /// A round of the circle, metres, for a scale of 1.
    pub const ROUND: f64 = TAU * Self::RADIUS;
    /// The reach of every closed route from the middle of the site, metres, for a scale of 1.
    pub const REACH: f64 = 10.0;

    pub fn new(options: &Options) -> Self {
        let survey = options.route == RouteKind::Survey;
        let share =
            (options.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 11) as f64 / (1u64 << 53) as f64;
        Self {
            kind: options.route,
            centre: Vector2::zeros(),
            scale: options.round.map_or(1.0, |round| round / Self::ROUND),
            beside: options.beside,
            start: share * TAU,
            speed: options.speed,
            between_stops: options.stops.unwrap_or(if survey { 6.0 } else { 0.0 }),
            turns: survey,
            pan: options.pan.unwrap_or(if survey { -TAU / 4.0 } else { 0.0 }),
            tilt: options.tilt,
            mast: options.mast,
            baseline: options.baseline,
        }
    }

    /// The place after `s` metres (of the fastest driving: the loop slows down in its bends).
    pub fn place(&self, s: f64) -> Vector2<f64> {
        let s = s / self.scale;
        let at = match self.kind {
            RouteKind::Circle => {
                let angle = self.start + s / Self::RADIUS;
                let beside = self.beside / self.scale * (angle - self.start) / TAU;
                let radius = Self::RADIUS + 0.8 * (3.0 * angle + self.start).sin() + beside;
                Vector2::new(angle.cos(), angle.sin()) * radius
            }
            RouteKind::Loop => {
                // A figure of eight, of which the middle is crossed twice a round.
                let (long, wide) = (8.0, 4.0f64);
                let angle = self.start + s / (long * long + 4.0 * wide * wide).sqrt();
                Vector2::new(long * angle.sin(), wide * (2.0 * angle).sin())
            }
            RouteKind::Survey => lanes(s),
            RouteKind::Straight => Vector2::new(self.start.cos(), self.start.sin()) * s,
        };
        self.centre + at * self.scale
    }

    /// Whether the first `length` metres stay so near to the middle of the site, at the right scale.
    pub fn stays_within(&self, reach: f64, length: f64) -> bool {
        self.kind != RouteKind::Straight || length + 1.0 < reach
    }

    /// The unit vector ahead after `s` metres.
    fn heading(&self, s: f64) -> Vector2<f64> {
        let e = 1e-4;
        (self.place(s + e) - self.place(s - e)).normalize()
    }

    /// Metres of [`Plan::place`] driven after a time, and how far the current stop has gone, 0 to 1.
    pub fn travelled(&self, time: f64) -> (f64, f64) {
        if self.between_stops <= 0.0 {
            return (self.speed * time, 0.0);
        }
        let ramp = RAMP.min(self.between_stops / self.speed);
        let drive = self.between_stops / self.speed + ramp;
        let stop = if self.turns { STOP_WITH_TURN } else { STOP };
        let cycles = (time / (drive + stop)).floor();
        let t = time - cycles * (drive + stop);
        // The speed rises and falls as half a cosine wave.
        let risen =
            |t: f64| self.speed * (t / 2.0 - ramp / TAU * (std::f64::consts::PI * t / ramp).sin());
        let s = if t < ramp {
            risen(t)
        } else if t < drive - ramp {
            self.speed * (t - ramp / 2.0)
        } else if t < drive {
            self.between_stops - risen(drive - t)
        } else {
            self.between_stops
        };
        (
            cycles * self.between_stops + s,
            ((t - drive) / stop).clamp(0.0, 1.0),
        )
    }

    /// The rover's middle on the ground at a time: maps its frame (x ahead, y left, z up) to the
    /// world. Six wheels on rockers, each rolling over what lies under its tread, carry the plane
    /// that fits them best.
    #[allow(non_snake_case)]
    pub fn T_world_body(&self, surface: &Surface, time: f64) -> Se3 {
        let (s, _) = self.travelled(time);
        let (here, ahead) = (self.place(s), self.heading(s));
        let left = Vector2::new(-ahead.y, ahead.x);
        let (mut mean, mut rise, mut roll) = (0.0, 0.0, 0.0);
        let (along, across) = WHEELS;
        for x in along {
            for y in [-across, across] {
                let height = tread(surface, here + ahead * x + left * y, ahead, left);
                mean += height / 6.0;
                rise += x * height;
                roll += y * height;
            }
        }
        let spread: f64 = along.iter().map(|x| 2.0 * x * x).sum();
        let (rise, roll) = (rise / spread, roll / (6.0 * across * across));
        let x = Vector3::new(ahead.x, ahead.y, rise).normalize();
        let slant = Vector3::new(left.x, left.y, roll);
        let z = x.cross(&slant).normalize();
        let axes = Matrix3::from_columns(&[x, z.cross(&x), z]);
        Se3::from_parts(
            Translation3::new(here.x, here.y, mean),
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
        )
    }

    /// The left camera at a time. The pair turns about its middle, on top of the mast.
    #[allow(non_snake_case)]
    pub fn T_world_cam(&self, surface: &Surface, time: f64) -> Se3 {
        let (_, stopped) = self.travelled(time);
        // Rises without a jump of speed or acceleration.
        let turned = stopped.powi(3) * (stopped * (6.0 * stopped - 15.0) + 10.0);
        let pan = self.pan + if self.turns { TAU * turned } else { 0.0 };
        let ahead = Vector3::new(pan.cos(), pan.sin(), 0.0);
        let z = ahead * self.tilt.cos() - Vector3::z() * self.tilt.sin();
        let x = ahead.cross(&Vector3::z());
        let axes = Matrix3::from_columns(&[x, z.cross(&x), z]);
        let middle = Vector3::new(0.0, 0.0, self.mast);
        let T_body_cam = Se3::from_parts(
            Translation3::from(middle - x * (self.baseline / 2.0)),
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
        );
        self.T_world_body(surface, time) * T_body_cam
    }
}

/// The height that a wheel stands at: the mean under its tread, smooth towards the tread's ends.
fn tread(surface: &Surface, at: Vector2<f64>, ahead: Vector2<f64>, left: Vector2<f64>) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for i in -3..=3 {
        let weight = 1.0 - (f64::from(i) / 4.0).powi(2);
        for j in -1..=1 {
            let p = at + ahead * (0.05 * f64::from(i)) + left * (0.05 * f64::from(j));
            sum += weight * surface.height(p.x, p.y);
            weights += weight;
        }
    }
    sum / weights
}

/// A closed survey: six lanes of 11 m, two metres apart, and the way back.
fn lanes(s: f64) -> Vector2<f64> {
    const CORNERS: [(f64, f64); 12] = [
        (-6.5, -5.0),
        (5.0, -5.0),
        (5.0, -3.0),
        (-4.0, -3.0),
        (-4.0, -1.0),
        (5.0, -1.0),
        (5.0, 1.0),
        (-4.0, 1.0),
        (-4.0, 3.0),
        (5.0, 3.0),
        (5.0, 5.0),
        (-6.5, 5.0),
    ];
    let corner = |k: usize| {
        let (x, y) = CORNERS[k % CORNERS.len()];
        Vector2::new(x, y)
    };
    // Every corner turns by a right angle: its arc replaces twice its radius of the sides.
    let arc = CORNER * TAU / 4.0;
    let side = |k: usize| (corner(k + 1) - corner(k)).norm() - 2.0 * CORNER;
    let round: f64 = (0..CORNERS.len()).map(|k| side(k) + arc).sum();
    let mut s = s.rem_euclid(round);
    for k in 0..CORNERS.len() {
        let ahead = (corner(k + 1) - corner(k)).normalize();
        if s <= side(k) {
            return corner(k) + ahead * (CORNER + s);
        }
        s -= side(k);
        if s <= arc {
            let next = (corner(k + 2) - corner(k + 1)).normalize();
            let (sin, cos) = (s / CORNER).sin_cos();
            return corner(k + 1) - ahead * CORNER * (1.0 - sin) + next * CORNER * (1.0 - cos);
        }
        s -= arc;
    }
    corner(0) + Vector2::new(CORNER, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(spec: &str) -> Plan {
        Plan::new(&Options::parse(spec, false).unwrap())
    }

    #[test]
    fn routes_are_driven_without_jumps_and_stay_on_the_site() {
        for route in ["circle", "loop", "survey", "straight"] {
            let plan = plan(&format!("route={route},seed=3"));
            for k in 0..6000 {
                let (a, b) = (
                    plan.place(k as f64 * 0.02),
                    plan.place((k + 1) as f64 * 0.02),
                );
                let step = (b - a).norm();
                assert!((0.005..0.032).contains(&step), "{route} {k}: {step}");
                assert!(
                    route == "straight" || a.norm() <= Plan::REACH,
                    "{route}: {a}"
                );
                let (x, y) = (plan.heading(k as f64 * 0.02), (b - a) / step);
                assert!((x - y).norm() < 0.03, "{route} {k}: {x} {y}");
            }
        }
    }

    #[test]
    fn a_round_is_as_long_as_asked_for() {
        for round in [20.0, 55.0] {
            let plan = plan(&format!("round={round},seed=3"));
            assert!((plan.place(round) - plan.place(0.0)).norm() < 1e-9);
            assert!((plan.place(round / 2.0) - plan.place(0.0)).norm() > 0.25 * round);
            let wider = Plan {
                beside: 0.3,
                ..plan
            };
            assert!(((wider.place(round) - wider.place(0.0)).norm() - 0.3).abs() < 1e-9);
        }
    }

    #[test]
    fn stops_begin_and_end_gently_and_the_mast_turns_once_around() {
        let plan = plan("route=survey,speed=0.3");
        let speed = |t: f64| (plan.travelled(t + 5e-4).0 - plan.travelled(t - 5e-4).0) / 1e-3;
        let mut before = speed(0.01);
        let (mut stood, mut drove) = (0, 0);
        for k in 1..9000 {
            let now = speed(0.01 + k as f64 * 0.01);
            assert!((-1e-9..0.301).contains(&now) && (now - before).abs() < 0.005);
            stood += u32::from(now < 1e-9);
            drove += u32::from((now - 0.3).abs() < 1e-9);
            before = now;
        }
        assert!(stood > 3000 && drove > 3000, "{stood} {drove}");

        let surface = Surface::new(
            64,
            0.5,
            nalgebra::Point3::origin(),
            None,
            vec![0.0; 64 * 64],
        );
        let stop = 6.0 / 0.3 + RAMP;
        let ahead = |t: f64| plan.T_world_cam(&surface, t).rotation * Vector3::z();
        let quarter = ahead(stop + 12.0);
        // Half the time, half the turn: it looks the other way.
        assert!((quarter.xy() + ahead(stop).xy()).norm() < 1e-6);
        assert!((ahead(stop + 24.0) - ahead(stop)).norm() < 1e-6);
        let T = plan.T_world_cam(&surface, 1.0);
        assert!((T.translation.z - 0.8).abs() < 1e-6, "{T}");
    }

    #[test]
    fn the_rover_stands_on_a_slope_as_the_slope() {
        // Control points of a plane make the plane.
        let control = (0..64 * 64).map(|k| 0.05 * (k % 64) as f32 + 0.02 * (k / 64) as f32);
        let surface = Surface::new(
            64,
            0.5,
            nalgebra::Point3::new(-16.0, -16.0, 0.0),
            None,
            control.collect(),
        );
        let plan = plan("route=circle,seed=2");
        for time in [0.0, 11.0, 77.0] {
            let up = plan.T_world_body(&surface, time).rotation * Vector3::z();
            let normal = Vector3::new(-0.1, -0.04, 1.0).normalize();
            assert!((up - normal).norm() < 1e-5, "{up}");
        }
    }
}
