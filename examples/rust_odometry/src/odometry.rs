// SPDX-License-Identifier: Apache-2.0
//! Decodes `nav_msgs/msg/Odometry` from CDR.

/// What is printed of a `nav_msgs/msg/Odometry`.
#[derive(Debug, PartialEq)]
pub struct Odometry {
    pub time_s: f64,
    pub frame: String,
    pub child_frame: String,
    /// x, y, z in `frame`, metres.
    pub position_m: [f64; 3],
    /// Child frame to `frame`: x, y, z, w.
    pub q_xyzw: [f64; 4],
    /// In the axes of the child frame, m/s.
    pub velocity_m_s: [f64; 3],
    /// In the axes of the child frame, rad/s.
    pub rate_rad_s: [f64; 3],
}

/// Reads little-endian CDR (OMG DDS-RTPS): values are aligned to their size, counted from behind the header of 4 bytes.
struct Cdr<'a> {
    body: &'a [u8],
    at: usize,
}

impl<'a> Cdr<'a> {
    fn new(payload: &'a [u8]) -> Result<Self, String> {
        match payload {
            [0, 1, _, _, body @ ..] => Ok(Cdr { body, at: 0 }),
            _ => Err("no little-endian CDR".into()),
        }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let begin = self.at.next_multiple_of(N);
        let bytes = self
            .body
            .get(begin..begin + N)
            .ok_or("message is cut off")?;
        self.at = begin + N;
        Ok(bytes.try_into().expect("N bytes"))
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.take().map(u32::from_le_bytes)
    }

    fn i32(&mut self) -> Result<i32, String> {
        self.take().map(i32::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], String> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = f64::from_le_bytes(self.take()?);
        }
        Ok(out)
    }

    /// A string with its length and a zero at its end.
    fn string(&mut self) -> Result<String, String> {
        let length = self.u32()? as usize;
        let end = self.at.checked_add(length).ok_or("message is cut off")?;
        let bytes = self.body.get(self.at..end).ok_or("message is cut off")?;
        self.at = end;
        let text = bytes.strip_suffix(&[0]).ok_or("string without an end")?;
        String::from_utf8(text.to_vec()).map_err(|error| error.to_string())
    }
}

/// Returns the message, or why the bytes are none.
pub fn odometry(payload: &[u8]) -> Result<Odometry, String> {
    let mut cdr = Cdr::new(payload)?;
    let time_s = f64::from(cdr.i32()?) + 1e-9 * f64::from(cdr.u32()?);
    let (frame, child_frame) = (cdr.string()?, cdr.string()?);
    let (position_m, q_xyzw) = (cdr.f64s()?, cdr.f64s()?);
    cdr.f64s::<36>()?; // covariance of the pose
    let (velocity_m_s, rate_rad_s) = (cdr.f64s()?, cdr.f64s()?);
    cdr.f64s::<36>()?; // covariance of the twist
    Ok(Odometry {
        time_s,
        frame,
        child_frame,
        position_m,
        q_xyzw,
        velocity_m_s,
        rate_rad_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damaged_messages_are_errors() {
        for payload in [
            &[][..],
            &[0, 0, 0, 0],
            &[0, 1, 0, 0, 1],
            &[0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255, 255, 255, 255],
        ] {
            assert!(odometry(payload).is_err(), "{payload:?}");
        }
    }

    #[test]
    fn doubles_are_aligned_behind_strings() {
        let mut payload = vec![0, 1, 0, 0];
        payload.extend(
            [
                2i32.to_le_bytes(),
                500_000_000i32.to_le_bytes(),
                2i32.to_le_bytes(),
            ]
            .concat(),
        );
        payload.extend(b"w\0\0\0"); // padded to the length of the next string
        payload.extend(2u32.to_le_bytes());
        payload.extend(b"c\0\0\0\0\0"); // padded to the doubles
        payload.truncate(4 + 24);
        for k in 0..85 {
            payload.extend(f64::from(k).to_le_bytes());
        }
        let o = odometry(&payload).unwrap();
        assert_eq!(
            (o.time_s, o.frame.as_str(), o.child_frame.as_str()),
            (2.5, "w", "c")
        );
        assert_eq!(
            (o.position_m, o.q_xyzw),
            ([0.0, 1.0, 2.0], [3.0, 4.0, 5.0, 6.0])
        );
        assert_eq!(
            (o.velocity_m_s, o.rate_rad_s),
            ([43.0, 44.0, 45.0], [46.0, 47.0, 48.0])
        );
    }
}
