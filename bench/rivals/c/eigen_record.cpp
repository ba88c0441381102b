// A record through a Kalman filter with Eigen's fixed-size matrices in the textbook form; no checks, no missing rows.
#include <cstdint>

#include <Eigen/Dense>

#include MODEL

template <int R, int C> using Matrix = Eigen::Matrix<double, R, C, (C == 1) ? Eigen::ColMajor : Eigen::RowMajor>;
template <int R, int C> using Constant = Eigen::Map<const Matrix<R, C>>;

extern "C" int64_t form_run(int64_t samples, const double *y, int32_t *status, double *state, double *covariance)
{
    const Constant<NX, NX> A(A_), Q(Q_), P0(P0_);
    const Constant<NY, NX> C(C_);
    const Constant<NY, NY> R(R_);
    Matrix<NX, 1> x = Matrix<NX, 1>::Zero();
    Matrix<NX, NX> P = A * P0 * A.transpose() + Q, T;
    Matrix<NY, NX> V;
    Matrix<NY, NY> S;
    Matrix<NY, 1> e;
    double nis = 0.0;
    for (int64_t t = 0; t < samples; ++t)
    {
        V.noalias() = C * P;
        S.noalias() = V * C.transpose();
        S += R;
        const Eigen::LLT<Matrix<NY, NY>> root(S);
        const Matrix<NY, NX> gain = root.solve(V);
        e = Constant<NY, 1>(y + t * NY);
        e.noalias() -= C * x;
        const Matrix<NY, 1> whitened = root.matrixL().solve(e);
        nis += whitened.squaredNorm();
        x.noalias() += gain.transpose() * e;
        P.noalias() -= gain.transpose() * V;
        Eigen::Map<Matrix<NX, 1>>(state + t * NX) = x;
        status[t] = nis >= 0.0 ? 0 : -5;
        if (t == samples - 1) Eigen::Map<Matrix<NX, NX>>(covariance).noalias() = P;
        x = (A * x).eval();
        T.noalias() = A * P;
        P.noalias() = T * A.transpose();
        P += Q;
    }
    return samples;
}
