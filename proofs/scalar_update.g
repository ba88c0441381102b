# Rounding of one update of a float kf with one state and one row, C = 1, in factors (`update = "ud"`):
# the statements of its C, one after the other. gappa proves the bounds; Coq checks the proof.
@fl = float<ieee_32, ne>;

x = fl(x_); y = fl(y_); p = fl(p_); r = fl(r_);  # any floats
innovation fl= y - x;
pivot fl= r + p;
inverse fl= 1 / pivot;
t0 fl= innovation * inverse;
correction fl= p * t0;
mean fl= x + correction;
covariance fl= p * fl(r / pivot);

Correction = p * ((y - x) * (1 / (r + p)));  # the same without rounding
Mean = x + Correction;
Covariance = p * (r / (r + p));

# The box. An innovation of less than 2^-100 that is not 0 is left out: there t0 may be subnormal.
{ |x| <= 512 /\ |y| <= 512 /\ |innovation| >= 1b-100 /\ p in [1b-10, 1024] /\ r in [1b-10, 1024]
  -> covariance -/ Covariance in [-1.7882e-7, 1.7882e-7] /\ |mean - Mean| <= 3.36e-4 }

# The gain is at most 1, which intervals alone do not see; tools/proofs.py has Coq prove this line.
Correction -> (y - x) * (1 / (1 + r / p)) { p <> 0, r + p <> 0, 1 + r / p <> 0 };
