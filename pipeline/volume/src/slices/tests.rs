use super::*;

#[test]
fn slice_distance_knows_no_order_of_storage() {
    let (w, h) = (40usize, 30usize);
    let inside = |x: usize, y: usize| {
        let (x, y) = (x as f64 - 19.3, y as f64 - 14.2);
        (x / 15.0).powi(2) + (y / 9.0).powi(2) < 1.0 && (x + 3.0).hypot(y - 8.0) > 5.0
    };
    let plane = |size: [usize; 2]| Plane {
        axes: [0, 1],
        size,
        e: [0.8, 0.0, 0.8],
        spacing: [0.8, 0.8],
    };
    let picture: Vec<u8> = (0..w * h).map(|n| u8::from(inside(n % w, n / w))).collect();
    let turned: Vec<u8> = (0..w * h).map(|n| u8::from(inside(n / h, n % h))).collect();
    let reversed: Vec<u8> = picture.iter().rev().copied().collect();
    // Sweeps pass over a nearer piece now and then, by a fiftieth of a pixel; single points were off by a third.
    let within = 0.03;
    for (name, picture, size) in [
        ("as drawn", &picture, [w, h]),
        ("turned", &turned, [h, w]),
        ("reversed", &reversed, [w, h]),
    ] {
        let plane = plane(size);
        let swept = plane.distance(picture, 0.7);
        let pieces = plane.contour(&plane.offsets(picture, 0.7));
        for (n, d) in swept.iter().enumerate() {
            let p = plane.mm((n % size[0]) as f32, (n / size[0]) as f32);
            let exact = pieces
                .iter()
                .map(|q| q.distance2(p))
                .fold(f32::MAX, f32::min)
                .sqrt();
            assert!((d.abs() - exact).abs() < within, "{name} {n}: {d} {exact}");
        }
    }
    let a = plane([w, h]).distance(&picture, 0.7);
    let b = plane([h, w]).distance(&turned, 0.7);
    let c = plane([w, h]).distance(&reversed, 0.7);
    for n in 0..w * h {
        let (x, y) = (n % w, n / w);
        for other in [b[x * h + y], c[w * h - 1 - n]] {
            assert!((a[n] - other).abs() < within, "{x} {y}: {} {other}", a[n]);
        }
    }
}
