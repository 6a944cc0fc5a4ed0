use std::fmt::Write;

use anyhow::{Result, bail};
use barchan_datasets::Sensors;
use barchan_geometry::{Se3, StampedPose, Trajectory};
use barchan_slam::{DeadReckoning, FusionConfig, ReckoningForm};
use clap::ValueEnum;

use crate::output::StagedDir;

/// A form of Bai's motion model by its name on the command line.
#[derive(Clone, Copy, ValueEnum)]
pub enum Form {
    /// As the paper prints it: no velocity, and what was gained in an interval counts twice
    Printed,
    /// With a velocity, and a gyro that reads a rate
    Corrected,
}

impl From<Form> for ReckoningForm {
    fn from(form: Form) -> Self {
        match form {
            Form::Printed => Self::Printed,
            Form::Corrected => Self::Corrected,
        }
    }
}

/// The path that acceleration and gyro alone give (Bai 2019, 2.4).
#[allow(non_snake_case)]
pub struct Reckoning {
    drive: DeadReckoning,
    T_imu_cam: Se3,
}

impl Reckoning {
    pub fn new(
        sensors: Option<&Sensors>,
        form: Form,
        config: &FusionConfig,
        data: &str,
    ) -> Result<Self> {
        let noise = [config.force_noise, config.rate_noise];
        let along = |s: &Sensors| DeadReckoning::new(&s.imu, form.into(), noise);
        let Some((sensors, drive)) = sensors.and_then(|s| Some((s, along(s)?))) else {
            bail!(
                "{data}: --dead-reckoning needs an IMU, and there is none\n  cure: leave it away"
            );
        };
        Ok(Self {
            drive,
            T_imu_cam: sensors.T_imu_cam,
        })
    }

    /// At these times: poses of the left camera in a level frame as `dead_reckoning.tum`; position and
    /// yaw of the IMU with their deviations as `dead_reckoning.csv`.
    #[allow(non_snake_case)]
    pub fn write(mut self, out: &StagedDir, times: impl Iterator<Item = f64>) -> Result<()> {
        let mut poses = Vec::new();
        let mut table = String::from("time,x,y,z,yaw,sx,sy,sz,syaw\n");
        for time in times {
            let Some(state) = self.drive.advance(time).copied() else {
                continue;
            };
            let T_world_cam = self.drive.T_start_imu() * self.T_imu_cam;
            poses.push(StampedPose { time, T_world_cam });
            let (p, variance) = (state.position, state.covariance.diagonal());
            let [sx, sy, sz, syaw] = [0, 1, 2, 6].map(|k| variance[k].sqrt());
            let yaw = state.yaw;
            writeln!(
                table,
                "{time},{},{},{},{yaw},{sx:e},{sy:e},{sz:e},{syaw:e}",
                p.x, p.y, p.z
            )?;
        }
        out.write("dead_reckoning.tum", Trajectory { poses }.to_tum())?;
        out.write("dead_reckoning.csv", table)
    }
}
