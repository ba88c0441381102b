(* Printed by tools/proofs.py from what SymPy judges, fkgen/oracle/theorems. *)
(* Matrices of any size by their laws alone; nothing is said of entries, and no axiom is left: what
   holds here holds of whatever has these laws, matrices of real numbers among it. *)
Section Matrices.
Variable Mat : nat -> nat -> Type.
Variable zero : forall {m n}, Mat m n.
Variable one : forall {n}, Mat n n.
Variable add : forall {m n}, Mat m n -> Mat m n -> Mat m n.
Variable opp : forall {m n}, Mat m n -> Mat m n.
Variable mul : forall {m n k}, Mat m n -> Mat n k -> Mat m k.
Variable tr : forall {m n}, Mat m n -> Mat n m.
Infix "+" := add.
Infix "*" := mul.
Notation "- x" := (opp x).
Hypothesis add_assoc : forall m n (a b c : Mat m n), (a + b) + c = a + (b + c).
Hypothesis add_comm : forall m n (a b : Mat m n), a + b = b + a.
Hypothesis add_zero : forall m n (a : Mat m n), a + zero = a.
Hypothesis add_opp : forall m n (a : Mat m n), a + - a = zero.
Hypothesis mul_assoc : forall m n k l (a : Mat m n) (b : Mat n k) (c : Mat k l), (a * b) * c = a * (b * c).
Hypothesis mul_one : forall m n (a : Mat m n), a * one = a.
Hypothesis one_mul : forall m n (a : Mat m n), one * a = a.
Hypothesis mul_add : forall m n k (a : Mat m n) (b c : Mat n k), a * (b + c) = a * b + a * c.
Hypothesis add_mul : forall m n k (a b : Mat m n) (c : Mat n k), (a + b) * c = a * c + b * c.
Hypothesis tr_add : forall m n (a b : Mat m n), tr (a + b) = tr a + tr b.
Hypothesis tr_mul : forall m n k (a : Mat m n) (b : Mat n k), tr (a * b) = tr b * tr a.
Hypothesis tr_tr : forall m n (a : Mat m n), tr (tr a) = a.

Lemma swap m n (a b c : Mat m n) : a + (b + c) = b + (a + c).
Proof. rewrite <- !add_assoc, (add_comm _ _ a b). reflexivity. Qed.
Lemma cancel m n (a b : Mat m n) : a + (- a + b) = b.
Proof. rewrite <- add_assoc, add_opp, add_comm, add_zero. reflexivity. Qed.
Lemma left m n (a b c : Mat m n) : a + b = a + c -> b = c.
Proof. intro H. rewrite <- (add_zero _ _ b), <- (add_zero _ _ c), <- (add_opp _ _ a), !(swap _ _ _ a), <- !(add_assoc _ _ a), H. 
  reflexivity. Qed.
Lemma opp_opp m n (a : Mat m n) : - - a = a.
Proof. apply (left _ _ (- a)). rewrite add_opp, add_comm, add_opp. reflexivity. Qed.
Lemma opp_add m n (a b : Mat m n) : - (a + b) = - a + - b.
Proof. apply (left _ _ (a + b)). rewrite add_opp, add_assoc, (swap _ _ b), cancel, add_opp. reflexivity. Qed.
Lemma zero_mul m n k (c : Mat n k) : (@zero m n) * c = zero.
Proof. apply (left _ _ (zero * c)). rewrite <- add_mul, !add_zero. reflexivity. Qed.
Lemma mul_zero m n k (c : Mat m n) : c * (@zero n k) = zero.
Proof. apply (left _ _ (c * zero)). rewrite <- mul_add, !add_zero. reflexivity. Qed.
Lemma opp_mul m n k (a : Mat m n) (b : Mat n k) : - a * b = - (a * b).
Proof. apply (left _ _ (a * b)). rewrite <- add_mul, !add_opp, zero_mul. reflexivity. Qed.
Lemma mul_opp m n k (a : Mat m n) (b : Mat n k) : a * - b = - (a * b).
Proof. apply (left _ _ (a * b)). rewrite <- mul_add, !add_opp, mul_zero. reflexivity. Qed.
Lemma tr_zero m n : tr (@zero m n) = zero.
Proof. apply (left _ _ (tr zero)). rewrite <- tr_add, !add_zero. reflexivity. Qed.
Lemma tr_opp m n (a : Mat m n) : tr (- a) = - tr a.
Proof. apply (left _ _ (tr a)). rewrite <- tr_add, !add_opp, tr_zero. reflexivity. Qed.
Lemma tr_one n : tr (@one n) = one.
Proof. rewrite <- (mul_one _ _ (tr one)), <- (tr_tr _ _ (tr one * one)), tr_mul, tr_tr, mul_one. apply tr_tr. Qed.
Lemma through m n k l (a : Mat m n) (b : Mat n k) (c : Mat m k) (d : Mat k l) : a * b = c -> a * (b * d) = c * d.
Proof. intro H. rewrite <- mul_assoc, H. reflexivity. Qed.
Lemma cancel_opp m n (a b : Mat m n) : - a + (a + b) = b.
Proof. apply (left _ _ a), cancel. Qed.
Lemma through3 m n k l j (a : Mat m n) (b : Mat n k) (c : Mat k l) (d : Mat m l) (e : Mat l j) :
  a * (b * c) = d -> a * (b * (c * e)) = d * e.
Proof. intro H. rewrite <- H, !mul_assoc. reflexivity. Qed.
Lemma difference m n (a b : Mat m n) : a + (- b + zero) = zero -> a = b.
Proof. rewrite add_zero. intro H. apply (left _ _ (- b)). rewrite (add_comm _ _ _ a), H, add_comm, add_opp. reflexivity. Qed.

(* To sums of products, each product to the right. *)
Ltac expand := repeat first [ rewrite tr_add | rewrite tr_mul | rewrite tr_opp | rewrite tr_one | rewrite tr_tr
  | rewrite mul_add | rewrite add_mul | rewrite opp_mul | rewrite mul_opp | rewrite opp_add | rewrite opp_opp
  | rewrite mul_one | rewrite one_mul | rewrite mul_assoc | rewrite add_assoc
  | match goal with H : tr ?P = ?P |- _ => rewrite H end ].
Ltac bring t := repeat (lazymatch goal with |- _ + (t + _) = _ => fail | _ => progress rewrite (swap _ _ _ t) end).
Ltac pair := lazymatch goal with
  | |- - ?x + _ = _ => bring x; rewrite cancel_opp
  | |- ?x + _ = _ => bring (- x); rewrite cancel
  end.

(* What is given, read from left to right wherever it stands, and its transpose. *)
Ltac use H := repeat (rewrite H || rewrite (through _ _ _ _ _ _ _ _ H) || rewrite (through3 _ _ _ _ _ _ _ _ _ _ H)).
Ltac transposed H H' := pose proof (f_equal (fun x => tr x) H) as H'; cbv beta in H'; revert H'; expand; intro H'.
Ltac equal := apply difference; expand.
Ltac collect := repeat pair; reflexivity.

(* the Joseph form is the standard form.
   Bierman 1977, any size, K S = P C' *)
Theorem the_joseph_form_is_the_standard_form :
  forall n p (P : Mat n n) (C : Mat p n) (S : Mat p p) (K : Mat n p),
  tr P = P -> tr S = S ->
  (P * tr C) = (K * S) ->
  ((K * (S + - (C * P * tr C)) * tr K) + ((one + - (K * C)) * P * (one + - (tr C * tr K)))) =
    (P + - (K * S * tr K)).
Proof.
  intros n p P C S K HP HS G0.
  rewrite ?mul_assoc in G0; transposed G0 TG0.
  repeat split; equal; repeat (progress (use G0; use TG0; expand)); collect.
Qed.

(* any other gain costs the square of what it is off by.
   Bierman 1977, any size, K S = P C' *)
Theorem any_other_gain_costs_the_square_of_what_it_is_off_by :
  forall n p (P : Mat n n) (C : Mat p n) (S : Mat p p) (K : Mat n p) (d : Mat n p),
  tr P = P -> tr S = S ->
  (P * tr C) = (K * S) ->
  (((one + - ((K + d) * C)) * P * (one + - (tr C * (tr K + tr d)))) + ((K + d) * (S + - (C * P * tr C)) * (tr K + tr d))) =
    (P + (d * S * tr d) + - (K * S * tr K)).
Proof.
  intros n p P C S K d HP HS G0.
  rewrite ?mul_assoc in G0; transposed G0 TG0.
  repeat split; equal; repeat (progress (use G0; use TG0; expand)); collect.
Qed.

(* sensors one after the other are both at once.
   Bierman 1977, any sizes, uncorrelated noises *)
Theorem sensors_one_after_the_other_are_both_at_once :
  forall n p q r (P : Mat n n) (C : Mat p n) (S : Mat p p) (K : Mat n p) (D : Mat q n) (L : Mat n q) (T : Mat q q) (x : Mat n r) (y : Mat p r) (z : Mat q r),
  tr P = P -> tr S = S -> tr T = T ->
  (P * tr C) = (K * S) ->
  (P * tr D) = ((L * T) + (K * S * tr K * tr D)) ->
  (((K + - (L * D * K)) * S) + (L * D * P * tr C)) =
    (P * tr C) /\
  ((L * (T + (D * K * S * tr K * tr D))) + ((K + - (L * D * K)) * C * P * tr D)) =
    (P * tr D) /\
  (P + - (L * D * P) + - ((K + - (L * D * K)) * C * P)) =
    (P + - (K * S * tr K) + - (L * T * tr L)) /\
  (x + (K * (y + - (C * x))) + (L * (z + - (D * (x + (K * (y + - (C * x)))))))) =
    (x + (L * (z + - (D * x))) + ((K + - (L * D * K)) * (y + - (C * x)))).
Proof.
  intros n p q r P C S K D L T x y z HP HS HT G0 G1.
  rewrite ?mul_assoc in G0; transposed G0 TG0.
  rewrite ?mul_assoc in G1; transposed G1 TG1.
  repeat split; equal; repeat (progress (use G0; use TG0; use G1; use TG1; expand)); collect.
Qed.

(* the gain (11) minimises (9), whose least value is (12).
   Strandt, Schneider & Yaz, any size, K Om = A P C' + B N D' *)
Theorem the_gain_11_minimises_9_whose_least_value_is_12 :
  forall m n p (P : Mat n n) (C : Mat p n) (S : Mat p p) (K : Mat n p) (A : Mat n n) (B : Mat n m) (N : Mat m m) (D : Mat p m) (Q : Mat n n) (d : Mat n p),
  tr P = P -> tr S = S -> tr N = N -> tr Q = Q ->
  (A * P * tr C) = ((K * S) + - (B * N * tr D)) ->
  (Q + ((A + - ((K + d) * C)) * P * (tr A + - (tr C * (tr K + tr d)))) + ((B + - ((K + d) * D)) * N * (tr B + - (tr D * (tr K + tr d)))) + ((K + d) * (S + - (C * P * tr C) + - (D * N * tr D)) * (tr K + tr d))) =
    (Q + (A * P * tr A) + (B * N * tr B) + (d * S * tr d) + - (K * S * tr K)).
Proof.
  intros m n p P C S K A B N D Q d HP HS HN HQ G0.
  rewrite ?mul_assoc in G0; transposed G0 TG0.
  repeat split; equal; repeat (progress (use G0; use TG0; expand)); collect.
Qed.

End Matrices.
Print Assumptions the_joseph_form_is_the_standard_form.
Print Assumptions any_other_gain_costs_the_square_of_what_it_is_off_by.
Print Assumptions sensors_one_after_the_other_are_both_at_once.
Print Assumptions the_gain_11_minimises_9_whose_least_value_is_12.
