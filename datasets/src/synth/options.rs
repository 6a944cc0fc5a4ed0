use std::path::PathBuf;
use std::str::FromStr;

use crate::DataError;

/// What [`super::Synth::parse`] and [`super::RandomScenes::parse`] understand, for help texts.
pub const OPTIONS: &str = "\
seed=1            chooses ground, route, light and noise
frames=60         how many pairs
width=384 height=288   image size, pixels
baseline=0.12     metres between the cameras
look=mars         mars, moon, arena or devon: colours, light and sky of a place
texture=rich      rich, real (with noise=2,blur=0.03 as hard as real sand) or low: contrast of the grain
dem=PATH          a GeoTIFF of heights in metres is the ground (no commas in PATH)
rocks=0.05        share of the ground under rocks (arena: 0.015; 0 with dem)
craters=1         how many craters, times the usual number
ripples=1         height of the wind ripples, times the usual 12 mm (arena: 24 mm)
tracks=true       wheel tracks of an earlier drive
sun=AZ:EL         degrees: where the sun stands, from x towards y, and above the horizon
sky=hazy          hazy, clear or black
route=circle      circle, loop (crosses itself), survey (lanes, stops, full turns) or straight
round=56          metres of a round of the circle, from 15; more than 56 only on a dem that has room
beside=0          metres that a round of the circle lies outside of the one before
speed=0.4         metres a second; a frame is taken every 0.2 s
stops=0           metres between stops of 6 s (survey: 6, with a full turn of the mast in 24 s)
pan=0             degrees, where the mast looks, to the left of ahead positive (survey: -90)
tilt=20           degrees down
mast=0.8          height of the cameras, metres
noise=1           sensor noise at mid grey, grey levels: shot and read noise
pattern=0         fixed pattern noise, share of the signal
exposure=1        times the automatic exposure
vignetting=0      share of light lost in the corners
bloom=0           veil around the sun and bright places, 0 to 1
blur=0            exposure time, seconds, that blurs motion
gain=0            how much brighter the right camera is, as a share
dust=0            specks of dust on each lens
rectified=true    false: images of a distorted, crooked rig, rectified on reading
sensor_noise=true false: IMU, odometry and GNSS without noise and bias
synth:scenes      random shapes instead of a traverse: seed, frames, width, height, baseline, noise,
                  clutter=1, 0 for a few large things with rich texture, and
                  bare=0, how many large things with next to no texture there are besides at most
synth:planes      flat walls at five tilts and growing distances, for `barchan noise`: the options of scenes";

/// How a place looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Look {
    Mars,
    Moon,
    Arena,
    Devon,
}

/// What is above the horizon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sky {
    Hazy,
    Clear,
    Black,
}

/// The plan of the drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RouteKind {
    Circle,
    Loop,
    Survey,
    Straight,
}

/// The options of a synthetic source; see [`OPTIONS`].
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Options {
    pub seed: u64,
    pub frames: usize,
    pub width: usize,
    pub height: usize,
    pub baseline: f64,
    pub look: Look,
    /// Contrast of the grain; 1 is rich.
    pub texture: f32,
    pub dem: Option<PathBuf>,
    pub rocks: Option<f64>,
    pub craters: f64,
    pub ripples: f64,
    pub tracks: bool,
    /// Azimuth and elevation, radians.
    pub sun: Option<[f64; 2]>,
    pub sky: Option<Sky>,
    pub route: RouteKind,
    /// Metres of a round of the circle.
    pub round: Option<f64>,
    /// Metres that each round lies outside of the one before.
    pub beside: f64,
    pub speed: f64,
    pub stops: Option<f64>,
    /// Radians.
    pub pan: Option<f64>,
    /// Radians.
    pub tilt: f64,
    pub mast: f64,
    pub camera: CameraOptions,
    pub rectified: bool,
    pub sensor_noise: bool,
    /// Of random scenes: 0 for a few large things with rich texture, 1 for all there is.
    pub clutter: f64,
    /// Of random scenes: how many large things with next to no texture there are besides at most.
    pub bare: usize,
}

/// What the cameras do to the light; see [`OPTIONS`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CameraOptions {
    pub noise: f64,
    pub pattern: f64,
    pub exposure: f64,
    pub vignetting: f64,
    pub bloom: f64,
    pub blur: f64,
    pub gain: f64,
    pub dust: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            seed: 1,
            frames: 60,
            width: 384,
            height: 288,
            baseline: 0.12,
            look: Look::Mars,
            texture: 1.0,
            dem: None,
            rocks: None,
            craters: 1.0,
            ripples: 1.0,
            tracks: true,
            sun: None,
            sky: None,
            route: RouteKind::Circle,
            round: None,
            beside: 0.0,
            speed: 0.4,
            stops: None,
            pan: None,
            tilt: 20.6f64.to_radians(),
            mast: 0.8,
            camera: CameraOptions {
                noise: 1.0,
                pattern: 0.0,
                exposure: 1.0,
                vignetting: 0.0,
                bloom: 0.0,
                blur: 0.0,
                gain: 0.0,
                dust: 0,
            },
            rectified: true,
            sensor_noise: true,
            clutter: 1.0,
            bare: 0,
        }
    }
}

impl Options {
    /// Reads `key=value,...`, each optional. `scenes` allows only what random scenes know.
    ///
    /// # Errors
    /// When an option is unknown or out of range; the message names it.
    pub fn parse(spec: &str, scenes: bool) -> Result<Self, DataError> {
        let mut options = Self::default();
        for item in spec.split(',').map(str::trim).filter(|i| !i.is_empty()) {
            let (key, value) = item.split_once('=').unwrap_or((item, ""));
            let reader = Reader { spec, key, value };
            let known = options.set_common(&reader)?
                || match scenes {
                    true => options.set_scenes(&reader)?,
                    false => options.set_rover(&reader)?,
                };
            if !known {
                let keys = if scenes {
                    format!("{}, clutter, bare", COMMON.join(", "))
                } else {
                    format!("{}, {}", COMMON.join(", "), ROVER.join(", "))
                };
                return Err(reader.bad(format!("unknown option \"{key}\"; known: {keys}")));
            }
        }
        // Hills ring the invented ground.
        if options.dem.is_none() && options.round.is_some_and(|round| round > 57.0) {
            return Err(DataError::Layout {
                spec: format!("synth:{spec}"),
                message: "a round of more than 56 m needs a dem=PATH that has room for it".into(),
            });
        }
        Ok(options)
    }

    fn set_common(&mut self, read: &Reader) -> Result<bool, DataError> {
        match read.key {
            "seed" => {
                self.seed = read
                    .value
                    .parse()
                    .map_err(|_| read.expected("a whole number"))?;
            }
            "frames" => self.frames = read.within(1, 1_000_000, "a whole number")?,
            "width" => self.width = read.within(32, 4096, "a whole number")?,
            "height" => self.height = read.within(32, 4096, "a whole number")?,
            "baseline" => self.baseline = read.within(0.01, 2.0, "metres")?,
            "noise" => self.camera.noise = read.within(0.0, 50.0, "grey levels")?,
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn set_scenes(&mut self, read: &Reader) -> Result<bool, DataError> {
        match read.key {
            "clutter" => self.clutter = read.within(0.0, 1.0, "a number")?,
            "bare" => self.bare = read.within(0, 100, "a whole number")?,
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn set_rover(&mut self, read: &Reader) -> Result<bool, DataError> {
        let camera = &mut self.camera;
        match read.key {
            "look" => {
                self.look = read.one_of(&[
                    ("mars", Look::Mars),
                    ("moon", Look::Moon),
                    ("arena", Look::Arena),
                    ("devon", Look::Devon),
                ])?;
            }
            "texture" => {
                self.texture = read.one_of(&[("rich", 1.0), ("real", 0.4), ("low", 0.15)])?;
            }
            "dem" if read.value.is_empty() => return Err(read.expected("the path of a GeoTIFF")),
            "dem" => self.dem = Some(PathBuf::from(read.value)),
            "rocks" => self.rocks = Some(read.within(0.0, 0.4, "a share")?),
            "craters" => self.craters = read.within(0.0, 10.0, "a number")?,
            "ripples" => self.ripples = read.within(0.0, 4.0, "a number")?,
            "tracks" => self.tracks = read.truth()?,
            "sun" => {
                let angles = read
                    .value
                    .split_once(':')
                    .and_then(|(a, e)| Some([a.parse::<f64>().ok()?, e.parse::<f64>().ok()?]))
                    .filter(|[a, e]| a.abs() <= 360.0 && (3.0..=85.0).contains(e));
                self.sun = Some(
                    angles
                        .ok_or_else(|| {
                            read.expected(
                                "AZIMUTH:ELEVATION in degrees, the elevation from 3 to 85",
                            )
                        })?
                        .map(f64::to_radians),
                );
            }
            "sky" => {
                self.sky = Some(read.one_of(&[
                    ("hazy", Sky::Hazy),
                    ("clear", Sky::Clear),
                    ("black", Sky::Black),
                ])?);
            }
            "route" => {
                self.route = read.one_of(&[
                    ("circle", RouteKind::Circle),
                    ("loop", RouteKind::Loop),
                    ("survey", RouteKind::Survey),
                    ("straight", RouteKind::Straight),
                ])?;
            }
            "round" => self.round = Some(read.within(15.0, 2000.0, "metres")?),
            "beside" => self.beside = read.within(0.0, 1.0, "metres")?,
            "speed" => self.speed = read.within(0.01, 2.0, "metres a second")?,
            "stops" => self.stops = Some(read.within(0.0, 1000.0, "metres")?),
            "pan" => self.pan = Some(read.within(-360.0f64, 360.0, "degrees")?.to_radians()),
            "tilt" => self.tilt = read.within(-20.0f64, 80.0, "degrees")?.to_radians(),
            "mast" => self.mast = read.within(0.2, 5.0, "metres")?,
            "pattern" => camera.pattern = read.within(0.0, 0.2, "a share")?,
            "exposure" => camera.exposure = read.within(0.05, 20.0, "a factor")?,
            "vignetting" => camera.vignetting = read.within(0.0, 0.9, "a share")?,
            "bloom" => camera.bloom = read.within(0.0, 1.0, "a number")?,
            "blur" => camera.blur = read.within(0.0, 0.2, "seconds")?,
            "gain" => camera.gain = read.within(-0.5, 1.0, "a share")?,
            "dust" => camera.dust = read.within(0, 200, "a whole number")?,
            "rectified" => self.rectified = read.truth()?,
            "sensor_noise" => self.sensor_noise = read.truth()?,
            _ => return Ok(false),
        }
        Ok(true)
    }
}

const COMMON: [&str; 6] = ["seed", "frames", "width", "height", "baseline", "noise"];
const ROVER: [&str; 26] = [
    "look",
    "texture",
    "dem",
    "rocks",
    "craters",
    "ripples",
    "tracks",
    "sun",
    "sky",
    "route",
    "round",
    "beside",
    "speed",
    "stops",
    "pan",
    "tilt",
    "mast",
    "pattern",
    "exposure",
    "vignetting",
    "bloom",
    "blur",
    "gain",
    "dust",
    "rectified",
    "sensor_noise",
];

/// One `key=value` of a specification.
struct Reader<'a> {
    spec: &'a str,
    key: &'a str,
    value: &'a str,
}

impl Reader<'_> {
    fn bad(&self, message: String) -> DataError {
        DataError::Layout {
            spec: format!("synth:{}", self.spec),
            message,
        }
    }

    fn expected(&self, what: &str) -> DataError {
        let Self { key, value, .. } = self;
        self.bad(format!("{key} is \"{value}\", expected {what}"))
    }

    fn within<T: FromStr + PartialOrd + std::fmt::Display>(
        &self,
        least: T,
        most: T,
        what: &str,
    ) -> Result<T, DataError> {
        let value = self.value.parse().ok();
        value
            .filter(|v| (&least..=&most).contains(&v))
            .ok_or_else(|| self.expected(&format!("{what} from {least} to {most}")))
    }

    fn truth(&self) -> Result<bool, DataError> {
        self.one_of(&[("true", true), ("false", false)])
    }

    fn one_of<T: Copy>(&self, choices: &[(&str, T)]) -> Result<T, DataError> {
        let found = choices.iter().find(|(name, _)| *name == self.value);
        found.map(|(_, value)| *value).ok_or_else(|| {
            let names: Vec<&str> = choices.iter().map(|(name, _)| *name).collect();
            self.expected(&names.join(", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_is_documented_and_known() {
        for key in COMMON.iter().chain(&ROVER) {
            assert!(OPTIONS.contains(&format!("{key}=")), "{key}");
            let message = Options::parse(&format!("{key}=?"), false)
                .err()
                .map(|e| e.to_string())
                .unwrap_or_default();
            // Any text is a path.
            assert!(
                *key == "dem" || message.contains(&format!("{key} is \"?\"")),
                "{key}: {message}"
            );
        }
        assert!(Options::parse("mast=1", true).is_err());
    }

    #[test]
    fn options_are_read() {
        let options = Options::parse("sun=-90:30,sky=black,route=survey,dem=a/b.tif", false);
        let options = options.unwrap();
        let [azimuth, elevation] = options.sun.unwrap();
        assert!((azimuth.to_degrees() + 90.0).abs() < 1e-9);
        assert!((elevation.to_degrees() - 30.0).abs() < 1e-9);
        assert_eq!(options.sky, Some(Sky::Black));
        assert_eq!(options.route, RouteKind::Survey);
        assert_eq!(options.dem, Some(PathBuf::from("a/b.tif")));
        for bad in [
            "sun=1:2",
            "sun=10",
            "dem=",
            "dem",
            "speed=nan",
            "tracks=1",
            "round=100",
        ] {
            assert!(Options::parse(bad, false).is_err(), "{bad}");
        }
    }
}
