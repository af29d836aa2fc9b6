// SPDX-License-Identifier: Apache-2.0
//! Prints the odometry of a chaser as the bridge to ROS 2 publishes it: CDR over Zenoh, without ROS.
//!
//!     cargo run -- tcp/127.0.0.1:7447 [NUMBER OF MESSAGES]

mod odometry;

use odometry::odometry;
use std::error::Error;
use zenoh::{Config, Wait};

/// Any domain, any chaser; the last part is the hash of the type.
const KEY: &str = "*/chaser_$*/odometry/nav_msgs::msg::dds_::Odometry_/*";

fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut arguments = std::env::args().skip(1);
    let endpoint = arguments
        .next()
        .unwrap_or_else(|| "tcp/127.0.0.1:7447".into());
    let count: usize = arguments.next().map_or(Ok(usize::MAX), |n| n.parse())?;
    let mut config = Config::default();
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("scouting/multicast/enabled", "false")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    let session = zenoh::open(config).wait()?;
    let subscriber = session.declare_subscriber(KEY).wait()?;
    eprintln!("subscribed");
    for _ in 0..count {
        let sample = subscriber.recv()?;
        match odometry(&sample.payload().to_bytes()) {
            Ok(o) => println!(
                "{:.3} {} in {}: position {:.6?} m, q {:.6?}, velocity {:.6?} m/s, rate {:.6?} rad/s",
                o.time_s, o.child_frame, o.frame, o.position_m, o.q_xyzw, o.velocity_m_s, o.rate_rad_s
            ),
            Err(reason) => eprintln!("{}: {reason}", sample.key_expr()),
        }
    }
    session.close().wait()
}
